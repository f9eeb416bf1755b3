"""Positions of points of the gel in pictures: lens and view of a camera from boards, and rectification."""
