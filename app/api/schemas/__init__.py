"""Requests and responses of the REST interface, as pydantic models."""
