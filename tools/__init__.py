"""Programs that build a release; no part of the gateway."""
