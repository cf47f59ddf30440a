"""An AVIS put together from masses, springs and dampers in explicit coordinates: shares nothing with `gap`.

    M z'' + C z' + K z = T u + C_w w' + K_w w,    displacements of the sensors R z

z holds the six coordinates of the payload and whatever is added, w the three displacements of the floor.
"""

from __future__ import annotations

import numpy as np
from table_in_time import Table, mount_map


class Assembly:
    """Payload, motors and sensors of a rig, `added` coordinates beside the six; nothing holds it yet."""

    def __init__(self, rig, added=0):
        table, n = Table(rig), 6 + added
        self.rig, self.n, self.maps = rig, n, table.maps
        self.M, self.K, self.C = (np.zeros((n, n)) for _ in range(3))
        self.M[:6, :6] = table.M
        self.K_w, self.C_w = np.zeros((n, 3)), np.zeros((n, 3))
        self.T, self.R = np.vstack([table.T, np.zeros((added, 8))]), np.hstack([table.R, np.zeros((6, added))])

    def row(self, own=(), **added):
        """A row over z: the payload's part, and e0=.. e1=.. for the first, second .. added coordinate."""
        found = np.zeros(self.n)
        found[: len(own)] = own
        for name, value in added.items():
            found[6 + int(name[1:])] = value
        return found

    def mass(self, row, m):
        self.M += m * np.outer(row, row)

    def spring(self, row, k, c=0.0, floor=(0.0, 0.0, 0.0)):
        """Force -k d - c d' along d = row z - floor w; k may be complex."""
        self.K, self.C = self.K + k * np.outer(row, row), self.C + c * np.outer(row, row)
        self.K_w, self.C_w = self.K_w + k * np.outer(row, floor), self.C_w + c * np.outer(row, floor)

    def mounts(self, without=()):
        """All mounts to the floor but those along the axes named."""
        for G, one in zip(self.maps, self.rig.isolators, strict=True):
            for a, axis in enumerate("xyz"):
                if axis not in without:
                    self.spring(self.row(G[a]), one.stiffness[a], one.damping[a], np.eye(3)[a])
        return self

    def response(self, f):
        """(n, 6, 11) sensor displacements by motor volts and floor velocities."""
        found = []
        for s in 2j * np.pi * np.asarray(f):
            force = np.hstack([self.T, self.K_w / s + self.C_w])
            found.append(self.R @ np.linalg.solve(s**2 * self.M + s * self.C + self.K, force))
        return np.array(found)


def chain(rig, f):
    """(n,) V per m/s: geophone, compensation to the lower corner, preamplifier."""
    s, g = 2j * np.pi * np.asarray(f), rig.geophones
    w, z = 2 * np.pi * g.compensated_Hz, g.compensated_damping
    return g.sensitivity_Vs_per_m[0] * g.preamplifier_gain * s**2 / (s**2 + 2 * z * w * s + w**2)


__all__ = ["Assembly", "chain", "mount_map"]
