"""Poses of sensors and cameras on their arms, and the latency of their pictures."""
