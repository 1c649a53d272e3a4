"""How the packaged networks are made. Needs the extra `train`; no package imports it."""
