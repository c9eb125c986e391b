"""Child processes: clients, server loops, and the messages between them."""
