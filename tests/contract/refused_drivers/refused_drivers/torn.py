"""The driver `torn`: its module cannot be imported."""

import no_such_vendor_library  # noqa: F401
