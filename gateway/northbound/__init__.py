"""The Zenoh side of the gateway: one session, one publishing thread, bounded queues.

`Northbound` is made with `ZenohConfig` and the `Plant` it publishes, and `run`s until it is
cancelled. It never blocks the event loop, and no package below it imports Zenoh. The package has no
names of its own: the command line uses some modules, and does not wait for the import of the rest.
"""
