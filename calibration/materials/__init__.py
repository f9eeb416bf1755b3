"""What gels and bodies are made of, from recorded presses and squeezes."""
