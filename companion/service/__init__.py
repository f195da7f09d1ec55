"""The companion service: assembly, supervision, the asyncio loop."""

from companion.service.event import Event
from companion.service.service import Service

__all__ = ["Event", "Service"]
