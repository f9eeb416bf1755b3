"""Materials from recorded presses and squeezes."""
