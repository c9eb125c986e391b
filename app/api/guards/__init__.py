"""What stands before every route and socket: who may come in, how much, how often and how slowly."""
