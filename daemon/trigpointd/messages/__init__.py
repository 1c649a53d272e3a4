"""What goes over the wire and into files: bytes in, core types out, and back."""
