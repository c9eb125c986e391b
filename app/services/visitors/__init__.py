"""What concerns the people who watch: who of them drives, and what their pages draw."""
