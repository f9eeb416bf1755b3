"""`tacsim train`, `evaluate`, `transfer`, and the export of policies."""
