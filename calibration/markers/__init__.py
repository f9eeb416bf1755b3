"""Flow from pictures: detection of printed dots, identification by their lattice, and tracking."""
