"""The bridge to InfluxDB, Telegraf, and all that takes its line protocol."""
