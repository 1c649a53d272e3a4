"""The commands of `trigpoint-db`, those that belong together in one module."""
