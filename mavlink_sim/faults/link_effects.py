"""Effects on the datagrams of a link: lost, late, duplicated, reordered, corrupted, limited in rate."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from mavlink_sim.faults.context import ActiveFault, FaultTarget
from mavlink_sim.faults.grammar import FaultError
from mavlink_sim.wire.link_faults import (
    Channel,
    Corruption,
    Delay,
    Duplication,
    Impairment,
    Loss,
    RateLimit,
    Reorder,
)


def chosen_links(vehicle: FaultTarget, link: str) -> list[str]:
    """The names of the selected links. Raises FaultError for one that the vehicle does not have."""
    if not vehicle.links:
        raise FaultError("link fault: this vehicle has no links")
    if link == "all":
        return list(vehicle.links)
    if link not in vehicle.links:
        raise FaultError(f"there is no link {link!r}; there are: all, {', '.join(vehicle.links)}")
    return [link]


def _channels(vehicle: FaultTarget, one: ActiveFault) -> list[tuple[str, Channel]]:
    """The selected directions, each with the seed of its random numbers."""
    values = one.fault.values
    found = []
    for name in chosen_links(vehicle, values["link"]):
        stage = vehicle.faults.stage(name)
        for direction, channel in (("out", stage.outbound), ("in", stage.inbound)):
            if values["way"] in ("both", direction):
                found.append((f"{one.seed}:{name}:{direction}", channel))
    return found


def _impair(vehicle: FaultTarget, one: ActiveFault, make: Callable[[str], Impairment]) -> None:
    for seed, channel in _channels(vehicle, one):
        impairment = make(seed)
        channel.impair(impairment)
        one.undo.append(partial(channel.clear, impairment))


def link_loss(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Drop everything, also what is in transit."""
    for _, channel in _channels(vehicle, one):
        channel.drop_waiting()
    _impair(vehicle, one, lambda seed: Loss(1.0, seed))


def link_delay(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Delay everything."""
    values = one.fault.values
    _impair(vehicle, one, lambda seed: Delay(values["seconds"], values["jitter"], seed))


def link_jitter(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Delay each datagram by a random time."""
    _impair(vehicle, one, lambda seed: Delay(0.0, one.fault.values["seconds"], seed))


def packet_loss(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Lose datagrams."""
    _impair(vehicle, one, lambda seed: Loss(one.fault.values["share"], seed))


def duplicate(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Duplicate datagrams."""
    _impair(vehicle, one, lambda seed: Duplication(one.fault.values["share"], seed))


def reorder(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Reorder datagrams."""
    values = one.fault.values
    _impair(vehicle, one, lambda seed: Reorder(values["share"], values["hold"], seed))


def corrupt(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Change bytes."""
    _impair(vehicle, one, lambda seed: Corruption(one.fault.values["share"], seed))


def rate_limit(vehicle: FaultTarget, one: ActiveFault) -> None:
    """Limit the data rate."""
    _impair(vehicle, one, lambda seed: RateLimit(one.fault.values["bytes_per_s"]))
