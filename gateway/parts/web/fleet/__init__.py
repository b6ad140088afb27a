"""All gateways under the prefix, on the page of one of them: `web: {fleet: files}`."""
