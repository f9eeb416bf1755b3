"""What drivers and mocks must both know, so that neither imports the other."""

MOCK_SERIAL = "00000000001"  # of mock controllers; no real arm has it, so a driver can tell
