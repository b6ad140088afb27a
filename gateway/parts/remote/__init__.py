"""Another configuration file over Zenoh: checked here, loaded, and put back by itself."""
