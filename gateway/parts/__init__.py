"""The parts of the service: each feature is one folder, and can fail without the plant."""
