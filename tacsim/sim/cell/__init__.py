"""A cell in MuJoCo behind the contract: arms, grippers, a rigid object between their gels, and views of it."""
