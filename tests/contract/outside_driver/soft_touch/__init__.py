"""A sensor whose picture is darker where its gel is pressed, and a gantry that carries it onto a hard, flat table."""
