"""The master's subscriptions, services and links to slaves."""
