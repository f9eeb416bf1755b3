"""Where points of the gel are seen: lens and view of a camera, found with boards, and its pictures rectified."""
