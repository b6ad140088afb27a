"""Alarms that reach people: by mail, webhook, MQTT or a command."""
