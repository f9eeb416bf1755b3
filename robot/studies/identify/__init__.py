"""From recorded presses and squeezes to materials."""
