"""MAVLink's services as PX4 offers them: commands, telemetry, parameters, missions, files, gimbals."""
