"""Materials of gels and bodies, from recorded presses and squeezes."""
