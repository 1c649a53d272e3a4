"""Networks: what is asked of them, and what is made of their outputs."""

import os

# Read when onnxruntime is first imported, below: it would send usage data and write to the home.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
