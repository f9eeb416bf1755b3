"""Similarity of the frames of two sources: `compare.compare_frames`, and `invariance` for a policy."""
