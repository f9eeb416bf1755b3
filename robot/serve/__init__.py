"""A live page of a rig (`tacsim serve`): look, start a policy, move by hand, take references, record, stop."""
