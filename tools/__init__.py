"""Tools of the checkout: checks that `make check` runs."""
