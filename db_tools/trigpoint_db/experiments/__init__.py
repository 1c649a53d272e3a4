"""The paper's experiments: each measures, and writes its table and its picture from the result."""
