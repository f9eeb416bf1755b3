"""Where pictures become flow: printed dots found, told apart by their lattice, and followed."""
