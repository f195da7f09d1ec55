"""The service: assembly, supervision, the one loop."""

from companion.service.event import Event
from companion.service.service import Service

__all__ = ["Event", "Service"]
