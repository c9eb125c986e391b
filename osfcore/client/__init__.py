"""A client of the service: what its REST interface offers, in the core's own types."""

from osfcore.client.answers import Episode, Estimate, Goal, Health, RemoteScene
from osfcore.client.client import Client
from osfcore.client.connection import ServiceError

__all__ = ["Client", "Episode", "Estimate", "Goal", "Health", "RemoteScene", "ServiceError"]
