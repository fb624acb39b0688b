"""Compares the region surfaces of a model with its input, independently of the builder, and prints one JSON object.

    overlap.py labels STL_FOLDER VOLUME NAME=LABEL...        voxels, later regions last
    overlap.py surfaces STL_FOLDER NAME=SURFACE.stl...       closed surfaces; a later one overrides earlier ones

Points on random vertical lines are looked up in the input and in the region surfaces (region-NAME.stl). For labels,
it lists the largest connected components of each region (voxels that share a face or an edge) as well.
"""

import json
import os
import sys

import nibabel
import numpy
import scipy.ndimage
import trimesh

LINES = 12800
STEP_MM = 0.2
COMPONENTS = 40
POINTS = 60


class Solid:
    """A closed surface that vertical lines cross."""

    def __init__(self, path):
        corners = trimesh.load_mesh(path, process=False).triangles
        self.corners = corners
        self.low = corners.min(axis=1)
        self.high = corners.max(axis=1)

    def contains(self, x, y, heights):
        """Whether the points at these heights have a winding number other than zero."""
        near = (
            (self.low[:, 0] <= x) & (x <= self.high[:, 0]) & (self.low[:, 1] <= y) & (y <= self.high[:, 1])
        )
        a, b, c = numpy.moveaxis(self.corners[near], 1, 0)

        def cross(p, q):
            return (p[:, 0] - x) * (q[:, 1] - y) - (p[:, 1] - y) * (q[:, 0] - x)

        weights = numpy.stack([cross(b, c), cross(c, a), cross(a, b)])
        hit = (weights > 0).all(axis=0) | (weights < 0).all(axis=0)
        weights = weights[:, hit]
        turns = -numpy.sign(weights[0]).astype(int)
        depths = (weights * numpy.stack([p[hit, 2] for p in (a, b, c)])).sum(axis=0) / weights.sum(axis=0)
        order = numpy.argsort(depths)
        winding = numpy.concatenate([[0], numpy.cumsum(turns[order])])
        return winding[numpy.searchsorted(depths[order], heights)] != 0


class Labels:
    """The voxels of a volume."""

    def __init__(self, path, labels):
        image = nibabel.load(path)
        self.voxels = numpy.asanyarray(image.dataobj)
        self.affine = image.affine
        self.back = numpy.linalg.inv(image.affine)
        self.volume = abs(numpy.linalg.det(image.affine[:3, :3]))
        self.labels = labels

    def regions(self, x, y, heights):
        points = numpy.column_stack([numpy.full(len(heights), x), numpy.full(len(heights), y), heights])
        at = numpy.rint(nibabel.affines.apply_affine(self.back, points)).astype(int)
        valid = ((at >= 0) & (at < self.voxels.shape)).all(axis=1)
        found = numpy.zeros(len(heights), int)
        found[valid] = self.voxels[tuple(at[valid].T)]
        return [found == label for label in self.labels]

    def components(self, r, solid, random):
        """The largest components: volume, and the part of it inside the model's region."""
        structure = scipy.ndimage.generate_binary_structure(3, 2)
        numbers, _ = scipy.ndimage.label(self.voxels == self.labels[r], structure)
        sizes = numpy.bincount(numbers.ravel())
        sizes[0] = 0
        largest = numpy.argsort(-sizes, kind="stable")[:COMPONENTS]
        places = scipy.ndimage.find_objects(numbers)
        found = []
        for number in largest[sizes[largest] > 0]:
            place = places[number - 1]
            own = numpy.argwhere(numbers[place] == number) + [s.start for s in place]
            chosen = own[random.integers(len(own), size=POINTS)] + random.uniform(-0.5, 0.5, (POINTS, 3))
            points = nibabel.affines.apply_affine(self.affine, chosen)
            kept = [solid.contains(x, y, [z])[0] for x, y, z in points]
            found.append({"volume_mm3": float(len(own) * self.volume), "kept": float(numpy.mean(kept))})
        return {"count": int((sizes * self.volume >= 1.0).sum()), "largest": found}


class Surfaces:
    """Closed surfaces, of which a later one overrides earlier ones."""

    def __init__(self, paths):
        self.solids = [Solid(path) for path in paths]

    def regions(self, x, y, heights):
        found = [solid.contains(x, y, heights) for solid in self.solids]
        taken = numpy.zeros(len(heights), bool)
        for inside in reversed(found):
            inside &= ~taken
            taken |= inside
        return found


def main(kind, folder, *rest):
    random = numpy.random.default_rng(5)
    volume, pairs = (rest[0], rest[1:]) if kind == "labels" else (None, rest)
    names, values = zip(*(pair.split("=", 1) for pair in pairs))
    source = Labels(volume, [int(v) for v in values]) if kind == "labels" else Surfaces(values)
    solids = [Solid(os.path.join(folder, f"region-{name}.stl")) for name in names]
    report = {}
    for r, name in enumerate(names):
        low = solids[r].low.min(axis=0) - 2.0
        high = solids[r].high.max(axis=0) + 2.0
        sums = numpy.zeros(3)
        for x, y in random.uniform(low[:2], high[:2], (LINES, 2)):
            heights = numpy.arange(low[2] + random.uniform(0.0, STEP_MM), high[2], STEP_MM)
            theirs = source.regions(x, y, heights)[r]
            ours = solids[r].contains(x, y, heights)
            sums += [theirs.sum(), ours.sum(), (theirs & ours).sum()]
        report[name] = {"dice": float(2.0 * sums[2] / sums[:2].sum())}
        if kind == "labels":
            report[name]["components"] = source.components(r, solids[r], random)
    json.dump(report, sys.stdout)


main(*sys.argv[1:])
