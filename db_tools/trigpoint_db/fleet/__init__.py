"""A map published to a fleet, and fetched from there."""
