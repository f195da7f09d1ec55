"""The flight commands as methods. Written by `python -m tools.client_commands`; do not edit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Literal

Reply = dict[str, Any]
"""`id`, `command`, `state`, `success`, `reason`; of a mission also `steps`, of select `track` and `class`."""

NON_FLIGHT = frozenset({"gimbal", "select", "stop"})
"""Commands that leave the vehicle's flight as it is, or that end it."""


class Commands(ABC):
    """The commands of docs/flight.md. An argument that is None has the service's default."""

    @abstractmethod
    async def command(self, text: str) -> Reply:
        """Send a command as text."""

    async def _run(self, word: str, **arguments: float | str | None) -> Reply:
        given = {key: value for key, value in arguments.items() if value is not None}
        written = (f"{key.removesuffix('_')}={_written(value)}" for key, value in given.items())
        return await self.command(" ".join([word, *written]))

    async def takeoff(self, altitude: float | None = None) -> Reply:
        """Arm, climb to a height above home and stay there.

        Args:
            altitude: height above home (1 to 50 m; default 2.5)
        """
        return await self._run("takeoff", altitude=altitude)

    async def land(self) -> Reply:
        """Land here and disarm."""
        return await self._run("land")

    async def rtl(self) -> Reply:
        """Return to home, land and disarm."""
        return await self._run("rtl")

    async def stop(self) -> Reply:
        """End offboard control; the autopilot holds the position."""
        return await self._run("stop")

    async def hold(self, duration: float | None = None) -> Reply:
        """Hold the current position by setpoints.

        Args:
            duration: how long; 0: until another command (0 to 3600 s; default 0)
        """
        return await self._run("hold", duration=duration)

    async def velocity(self, source: str | None = None) -> Reply:
        """Fly the velocities sent on the topic `velocity`; without one, brake and hold.

        Args:
            source: the sender to obey; default: the first one that is received
        """
        return await self._run("velocity", source=source)

    async def goto(
        self,
        north: float | None = None,
        east: float | None = None,
        altitude: float | None = None,
        forward: float | None = None,
        right: float | None = None,
        latitude: float | None = None,
        longitude: float | None = None,
        speed: float | None = None,
        heading: float | None = None,
    ) -> Reply:
        """Fly straight to a point, given by one pair: forward and right, north and east, latitude and
        longitude.

        Args:
            north: distance north of home; needs east (-5000 to 5000 m)
            east: distance east of home; needs north (-5000 to 5000 m)
            altitude: height above home; default: unchanged (1 to 500 m)
            forward: distance ahead of here; needs right (-5000 to 5000 m)
            right: distance right of here; needs forward (-5000 to 5000 m)
            latitude: WGS 84; needs longitude (-90 to 90 deg)
            longitude: WGS 84; needs latitude (-180 to 180 deg)
            speed: maximum speed (0.2 to 20 m/s; default 3)
            heading: yaw, clockwise from north; default: along the path (-360 to 360 deg)
        """
        return await self._run(
            "goto",
            north=north,
            east=east,
            altitude=altitude,
            forward=forward,
            right=right,
            latitude=latitude,
            longitude=longitude,
            speed=speed,
            heading=heading,
        )

    async def follow_path(
        self,
        points: str,
        speed: float | None = None,
        laps: float | None = None,
        yaw_mode: Literal["path", "hold"] | None = None,
    ) -> Reply:
        """Fly along a list of points, slowing down for corners.

        Args:
            points: north,east or north,east,height, metres from home: "0,0 10,0,5 10,10"
            speed: maximum speed (0.2 to 20 m/s; default 3)
            laps: how many; 0: until another command (0 to 1000; default 1)
            yaw_mode: yaw: along the path, or unchanged (default path)
        """
        return await self._run("follow-path", points=points, speed=speed, laps=laps, yaw_mode=yaw_mode)

    async def figure_eight(
        self,
        radius: float | None = None,
        speed: float | None = None,
        laps: float | None = None,
        yaw_mode: Literal["path", "hold"] | None = None,
    ) -> Reply:
        """Fly a level eight about the current position, first towards the nose.

        Args:
            radius: from its centre to either end (3 to 200 m; default 10)
            speed: maximum speed; bends are slower (0.2 to 20 m/s; default 2)
            laps: how many; 0: until another command (0 to 1000; default 1)
            yaw_mode: yaw: along the path, or unchanged (default path)
        """
        return await self._run("figure-eight", radius=radius, speed=speed, laps=laps, yaw_mode=yaw_mode)

    async def orbit(
        self,
        class_: str | None = None,
        radius: float | None = None,
        speed: float | None = None,
        laps: float | None = None,
        direction: Literal["clockwise", "counterclockwise"] | None = None,
        track: int | None = None,
        marker: int | None = None,
    ) -> Reply:
        """Circle, nose to the centre: the point `radius` ahead, an object of a class, a track or a marker.

        Args:
            class_: an object of this class
            radius: of the circle (1 to 100 m; default 10)
            speed: along the circle (0.1 to 10 m/s; default 2)
            laps: how many; 0: until another command (0 to 100; default 0)
            direction: seen from above (default clockwise)
            track: the object of this track
            marker: this printed marker
        """
        return await self._run(
            "orbit",
            class_=class_,
            radius=radius,
            speed=speed,
            laps=laps,
            direction=direction,
            track=track,
            marker=marker,
        )

    async def seek(
        self,
        class_: str,
        laps: float | None = None,
        rate: float | None = None,
        confidence: float | None = None,
        direction: Literal["clockwise", "counterclockwise"] | None = None,
        pattern: Literal["turn", "square", "lawnmower"] | None = None,
        radius: float | None = None,
        width: float | None = None,
        height: float | None = None,
        spacing: float | None = None,
        speed: float | None = None,
        sweep: float | None = None,
        sweep_rate: float | None = None,
    ) -> Reply:
        """Turn, or search an area, until an object of the class is found; then face it.

        Args:
            class_: what to search for
            laps: turns before giving up (0.25 to 20; default 2)
            rate: how fast to turn (0.05 to 1 rad/s; default 0.5)
            confidence: minimum confidence (0.05 to 1; default 0.4)
            direction: seen from above (default clockwise)
            pattern: on the spot, or over an area about it (default turn)
            radius: half a side of the expanding square (1 to 500 m)
            width: of the lawnmower's area, west to east (1 to 1000 m)
            height: of the lawnmower's area, south to north (1 to 1000 m)
            spacing: between strips; default: from the camera's footprint (1 to 200 m)
            speed: over an area, at most (0.2 to 20 m/s; default 2)
            sweep: gimbal sweep between level and this pitch; below is negative (-90 to 90 deg)
            sweep_rate: of the gimbal; slower also slows the turn (2 to 60 deg/s; default 20)
        """
        return await self._run(
            "seek",
            class_=class_,
            laps=laps,
            rate=rate,
            confidence=confidence,
            direction=direction,
            pattern=pattern,
            radius=radius,
            width=width,
            height=height,
            spacing=spacing,
            speed=speed,
            sweep=sweep,
            sweep_rate=sweep_rate,
        )

    async def approach(
        self,
        class_: str | None = None,
        distance: float | None = None,
        speed: float | None = None,
        confidence: float | None = None,
        lost_timeout: float | None = None,
        retries: float | None = None,
        gimbal: Literal["leave", "track"] | None = None,
        track: int | None = None,
        marker: int | None = None,
    ) -> Reply:
        """Fly to an object of the class, a track or a marker, keeping the height, and stop before it.

        Args:
            class_: an object of this class
            distance: where to stop, over ground to its nearest surface (1 to 100 m; default 5)
            speed: maximum speed (0.2 to 10 m/s; default 2)
            confidence: minimum confidence (0.05 to 1; default 0.3)
            lost_timeout: wait for a lost object this long (0.5 to 60 s; default 5)
            retries: how often to search for a lost object, unless it is a track or a marker (0 to 20; default
                2)
            gimbal: leave: not moved; track: camera kept on the object (default leave)
            track: the object of this track
            marker: this printed marker
        """
        return await self._run(
            "approach",
            class_=class_,
            distance=distance,
            speed=speed,
            confidence=confidence,
            lost_timeout=lost_timeout,
            retries=retries,
            gimbal=gimbal,
            track=track,
            marker=marker,
        )

    async def follow(
        self,
        class_: str | None = None,
        distance: float | None = None,
        bearing: Literal["here", "compass", "course"] | None = None,
        angle: float | None = None,
        speed: float | None = None,
        confidence: float | None = None,
        occlusion: float | None = None,
        duration: float | None = None,
        gimbal: Literal["leave", "track"] | None = None,
        track: int | None = None,
        marker: int | None = None,
    ) -> Reply:
        """Keep a distance and a bearing to a moving object of the class, a track or a marker.

        Args:
            class_: an object of this class
            distance: to keep, over ground to its nearest surface (1.5 to 100 m; default 8)
            bearing: where to stay: unchanged, or `angle` from north or course (default here)
            angle: seen from the object, clockwise; relative to its course 180 is behind (-360 to 360 deg;
                default 180)
            speed: maximum speed (0.2 to 20 m/s; default 5)
            confidence: minimum confidence (0.05 to 1; default 0.3)
            occlusion: follow a hidden object's predicted path this long (0.5 to 60 s; default 3)
            duration: how long; 0: until another command (0 to 3600 s; default 0)
            gimbal: leave: not moved; track: camera kept on the object (default leave)
            track: the object of this track
            marker: this printed marker
        """
        return await self._run(
            "follow",
            class_=class_,
            distance=distance,
            bearing=bearing,
            angle=angle,
            speed=speed,
            confidence=confidence,
            occlusion=occlusion,
            duration=duration,
            gimbal=gimbal,
            track=track,
            marker=marker,
        )

    async def policy(
        self,
        file: str,
        class_: str | None = None,
        distance: float | None = None,
        limit: float | None = None,
        track: int | None = None,
        marker: int | None = None,
    ) -> Reply:
        """Fly to an object by a trained policy and stop before it.

        Args:
            file: an ONNX file on the service's computer, or a bundled policy
            class_: an object of this class
            distance: where to stop, over ground to its nearest surface (1 to 100 m; default 5)
            limit: give up after this long (1 to 3600 s; default 120)
            track: the object of this track
            marker: this printed marker
        """
        return await self._run(
            "policy", file=file, class_=class_, distance=distance, limit=limit, track=track, marker=marker
        )

    async def patrol(
        self,
        points: str,
        classes: str,
        on_detection: Literal["hold", "approach"] | None = None,
        distance: float | None = None,
        dwell: float | None = None,
        revisit: float | None = None,
        merge_radius: float | None = None,
        speed: float | None = None,
        laps: float | None = None,
        confidence: float | None = None,
    ) -> Reply:
        """Fly a closed path repeatedly, and stop for detected objects.

        Args:
            points: the path: north,east or north,east,height, metres from home
            classes: what to stop for, separated by commas
            on_detection: stop and face it, or fly up to `distance` (default hold)
            distance: where an approach stops, over ground to the nearest surface (1 to 100 m; default 5)
            dwell: time spent at an object (0 to 600 s; default 5)
            revisit: time within which the same object is ignored (0 to 3600 s; default 120)
            merge_radius: detections within this distance are one object (0.5 to 100 m; default 5)
            speed: maximum speed (0.2 to 20 m/s; default 3)
            laps: how many; 0: until another command (0 to 1000; default 0)
            confidence: minimum confidence (0.05 to 1; default 0.4)
        """
        return await self._run(
            "patrol",
            points=points,
            classes=classes,
            on_detection=on_detection,
            distance=distance,
            dwell=dwell,
            revisit=revisit,
            merge_radius=merge_radius,
            speed=speed,
            laps=laps,
            confidence=confidence,
        )

    async def mission(self, file: str) -> Reply:
        """Fly the steps of a mission file, with their time-outs and branches.

        Args:
            file: a path on the service's computer, or the name of a bundled mission
        """
        return await self._run("mission", file=file)

    async def formation(
        self,
        shape: Literal["line", "column", "wedge", "circle"],
        leader: str,
        spacing: float | None = None,
        slot: str | None = None,
        points: str | None = None,
        speed: float | None = None,
        laps: float | None = None,
        lost_timeout: float | None = None,
    ) -> Reply:
        """Hold a slot about a leader: another vehicle, or a virtual one on a path.

        Args:
            shape: of the formation
            leader: vehicle.name of the leader, or "virtual"
            spacing: between neighbouring slots (1 to 100 m; default 6)
            slot: slot number from 1, or auto (default auto)
            points: path of a virtual leader, from home: "0,0 20,0 20,20,8"
            speed: maximum speed of a virtual leader (0.2 to 20 m/s; default 2)
            laps: of its path; 0: until another command (0 to 1000; default 1)
            lost_timeout: how long to hold without the leader's pose (0.5 to 600 s; default 5)
        """
        return await self._run(
            "formation",
            shape=shape,
            leader=leader,
            spacing=spacing,
            slot=slot,
            points=points,
            speed=speed,
            laps=laps,
            lost_timeout=lost_timeout,
        )

    async def land_on_marker(
        self,
        id: float,
        method: Literal["offboard", "autopilot"] | None = None,
        target: Literal["static", "moving"] | None = None,
        attempts: float | None = None,
        search: float | None = None,
        speed: float | None = None,
    ) -> Reply:
        """Find a marker below, descend onto it in a narrowing cone, land and disarm.

        Args:
            id: id of the pad's marker (0 to 1023)
            method: flown by setpoints, or by the autopilot with LANDING_TARGET (default offboard)
            target: whether the pad moves (default static)
            attempts: descents before giving up (1 to 10; default 3)
            search: radius of the search (0 to 50 m; default 5)
            speed: horizontal, at most (0.2 to 5 m/s; default 1.5)
        """
        return await self._run(
            "land-on-marker",
            id=id,
            method=method,
            target=target,
            attempts=attempts,
            search=search,
            speed=speed,
        )

    async def gimbal(
        self,
        pitch: float | None = None,
        yaw: float | None = None,
        class_: str | None = None,
        latitude: float | None = None,
        longitude: float | None = None,
        altitude: float | None = None,
        track: int | None = None,
        marker: int | None = None,
    ) -> Reply:
        """Point the gimbal during any behaviour, or keep it on an object or a place; default: level and
        ahead.

        Args:
            pitch: above the horizon; below is negative (-90 to 90 deg; default 0)
            yaw: clockwise from the nose (-180 to 180 deg; default 0)
            class_: an object of this class
            latitude: of a place to keep it on, WGS 84; needs longitude (-90 to 90 deg)
            longitude: WGS 84; needs latitude (-180 to 180 deg)
            altitude: of the place above home; default: 0 (-500 to 5000 m)
            track: the object of this track
            marker: this printed marker
        """
        return await self._run(
            "gimbal",
            pitch=pitch,
            yaw=yaw,
            class_=class_,
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            track=track,
            marker=marker,
        )

    async def select(
        self,
        x: float | None = None,
        y: float | None = None,
        width: float | None = None,
        height: float | None = None,
        camera: str | None = None,
        stamp_ns: float | None = None,
    ) -> Reply:
        """Select an object in an image as a track; without a rectangle: end the selection.

        Args:
            x: left edge, fraction of the image's width (0 to 1)
            y: upper edge, fraction of its height (0 to 1)
            width: fraction of the image's width (0 to 1)
            height: fraction of its height (0 to 1)
            camera: a table of cameras, or first; without: the steering camera
            stamp_ns: captured_ns of the image; without: the newest (0 to 9.22337e+18)
        """
        return await self._run(
            "select", x=x, y=y, width=width, height=height, camera=camera, stamp_ns=stamp_ns
        )


def _written(value: float | str) -> str:
    if not isinstance(value, str):
        return repr(value)
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
