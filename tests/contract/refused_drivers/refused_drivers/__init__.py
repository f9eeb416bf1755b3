"""Drivers that are refused, beside those of a distribution that `tacsim new driver soft-touch` makes."""
