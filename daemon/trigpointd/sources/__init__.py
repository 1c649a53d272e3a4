"""Where frames come from: cameras and recordings."""
