"""What outlives the service: the database, and files under the data directory."""
