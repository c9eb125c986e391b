"""What the learned parts are compared with."""
