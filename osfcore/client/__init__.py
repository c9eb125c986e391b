"""A client of the service: what its REST interface offers, in the core's own types."""

from osfcore.client.client import Client, Episode, Estimate, Goal, Health, RemoteScene, ServiceError

__all__ = ["Client", "Episode", "Estimate", "Goal", "Health", "RemoteScene", "ServiceError"]
