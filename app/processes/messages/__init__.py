"""What a process and the one that started it say to each other."""
