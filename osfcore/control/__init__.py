"""Visual model-predictive control: look, predict, plan, act, look again (paper section 4.4, Algorithm 1)."""
