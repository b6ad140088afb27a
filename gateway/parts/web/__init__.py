"""The HTTP side of the gateway: status page, JSON API, metrics and probes.

Nothing here is imported unless the file has `web`: `gateway.parts.web.server` needs aiohttp.
"""
