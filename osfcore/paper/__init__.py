"""The paper's own parts as it publishes them, for comparisons; nothing of them is needed to run ours."""
