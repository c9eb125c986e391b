"""The paper's action-conditioned dynamics model (its section 4.3, equations 7 and 8)."""
