"""Tags: how their settings become tags, each feature of a tag in a module of its own."""
