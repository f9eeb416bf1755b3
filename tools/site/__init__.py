"""Pages of the documentation site that are generated from the code: mkdocs.yml names hook.py, which adds them."""
