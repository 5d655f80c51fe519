"""What ekf_node says about itself and about what it receives."""
