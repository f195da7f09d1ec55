"""Vectors, and rotations as quaternions and matrices.

Plain floats in tuples: numpy scalars, or an object for a vector, would make a step of the simulation, and
every test in lockstep, several times slower.
"""

from __future__ import annotations

import math

Vector = tuple[float, float, float]
# (w, x, y, z), of length 1
Quaternion = tuple[float, float, float, float]
# row by row
Matrix = tuple[float, float, float, float, float, float, float, float, float]


def rotation_matrix(quaternion: Quaternion) -> Matrix:
    """The matrix of the same rotation."""
    w, x, y, z = quaternion
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


def integrated(ned_from_body: Quaternion, body_rates: Vector, dt_s: float) -> Quaternion:
    """The attitude after a short time at body rates, rad/s."""
    w, x, y, z = ned_from_body
    p, q, r = body_rates
    half_s = 0.5 * dt_s
    p, q, r = p * half_s, q * half_s, r * half_s
    new_w = w - x * p - y * q - z * r
    new_x = x + w * p + y * r - z * q
    new_y = y + w * q + z * p - x * r
    new_z = z + w * r + x * q - y * p
    scale = 1.0 / math.sqrt(new_w * new_w + new_x * new_x + new_y * new_y + new_z * new_z)
    return (new_w * scale, new_x * scale, new_y * scale, new_z * scale)


def turned(matrix: Matrix, vector: Vector) -> Vector:
    """The vector times the matrix."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = matrix
    x, y, z = vector
    return (xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z)


def turned_back(matrix: Matrix, vector: Vector) -> Vector:
    """The vector times the transposed matrix."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = matrix
    x, y, z = vector
    return (xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z)
