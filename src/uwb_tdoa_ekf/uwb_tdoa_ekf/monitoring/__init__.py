"""Check the input of ekf_node and its own state."""
