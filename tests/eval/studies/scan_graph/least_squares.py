"""Answer the requests of ``gtsam_program`` by dense Gauss-Newton in NumPy: a second optimiser for small graphs.

With it whole runs are tested where GTSAM is not installed, and compared where it is.
"""

import json
import sys

import numpy as np


def relation(a, b):
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = (b - a)[:, :2].T
    return np.stack([c * dx + s * dy, c * dy - s * dx, (b[:, 2] - a[:, 2] + np.pi) % (2.0 * np.pi) - np.pi], axis=-1)


def moved(a, d):
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return a + np.stack([c * d[:, 0] - s * d[:, 1], s * d[:, 0] + c * d[:, 1], d[:, 2]], axis=-1)


def turned(angle):
    """Return the matrices that turn places by angles and leave turns as they are."""
    found = np.tile(np.eye(3), (len(angle), 1, 1))
    found[:, 0, 0] = found[:, 1, 1] = np.cos(angle)
    found[:, 1, 0], found[:, 0, 1] = np.sin(angle), -np.sin(angle)
    return found


def carried(motion):
    """Return the matrices that take an error over a motion."""
    lever = np.tile(np.eye(3), (len(motion), 1, 1))
    lever[:, 0, 2], lever[:, 1, 2] = -motion[:, 1], motion[:, 0]
    return turned(-motion[:, 2]) @ lever


class Graph:
    def __init__(self):
        self.poses, self.factors = np.zeros((0, 3)), []

    def normal(self):
        """Return the cost, the normal matrix and the gradient; the first pose is held."""
        a, b, x, y, t, xx, xy, xt, yy, yt, tt, robust = np.array(self.factors, float).T
        a, b = a.astype(int), b.astype(int)
        weight = np.linalg.inv(np.stack([xx, xy, xt, xy, yy, yt, xt, yt, tt], axis=-1).reshape(-1, 3, 3))
        between = relation(self.poses[a], self.poses[b])
        e = relation(np.stack([x, y, t], axis=-1), between)
        squared = np.einsum("ki,kij,kj->k", e, weight, e)
        cost = np.where(robust > 0, 4.0 * np.log1p(squared / 4.0), squared).sum()
        weight = weight * np.where(robust > 0, 1.0 / (1.0 + squared / 4.0), 1.0)[:, None, None]
        of_b = turned(e[:, 2])
        J = {0: -of_b @ carried(between), 1: of_b}
        n = len(self.poses)
        H, g = np.zeros((n, 3, n, 3)), np.zeros((n, 3))
        for one, i in ((0, a), (1, b)):
            np.add.at(g, i, -np.einsum("kij,kil,kl->kj", J[one], weight, e))
            for other, j in ((0, a), (1, b)):
                np.add.at(H.transpose(0, 2, 1, 3), (i, j), np.einsum("kij,kil,klm->kjm", J[one], weight, J[other]))
        H[0, :, 0] += 1e12 * np.eye(3)
        return cost, H.reshape(3 * n, 3 * n), g

    def solve(self):
        cost, H, g = self.normal()
        damping = 1e-6
        for _ in range(100):
            kept, diagonal = self.poses, np.diag(damping * np.diag(H))
            self.poses = moved(kept, np.linalg.solve(H + diagonal, g.ravel()).reshape(-1, 3))
            now, *rest = self.normal()
            if now > cost:
                self.poses, damping = kept, 10.0 * damping
                continue
            settled, damping, (H, g) = cost - now < 1e-9 * cost, 0.1 * damping, rest
            cost = now
            if settled:
                break

    def covariances(self, pairs):
        n = len(self.poses)
        total = np.linalg.inv(self.normal()[1]).reshape(n, 3, n, 3)
        for a, b in pairs:
            J = np.hstack([-carried(relation(self.poses[[a]], self.poses[[b]]))[0], np.eye(3)])
            yield J @ total[np.ix_([a, b], range(3), [a, b], range(3))].reshape(6, 6) @ J.T


def say(answer):
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


def main():
    graph = Graph()
    sys.stdin.readline()
    say({"version": "least squares"})
    for line in sys.stdin:
        request, answer = json.loads(line), {}
        if request.get("clear"):
            graph.factors.clear()
        graph.poses = np.vstack([graph.poses, *request.get("poses", [])])
        graph.factors += request.get("factors", [])
        if request.get("solve"):
            graph.solve()
            answer["poses"] = graph.poses.tolist()
        if request.get("pairs"):
            answer["covariances"] = [c.ravel().tolist() for c in graph.covariances(request["pairs"])]
        say(answer)


if __name__ == "__main__":
    main()
