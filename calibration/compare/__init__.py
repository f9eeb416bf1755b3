"""How alike the frames of two sources are: `compare.compare_frames`, and `invariance` for a policy's view."""
