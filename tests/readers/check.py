"""Reads files of Palpate with independent packages and prints their content as one JSON object.

    check.py versions           versions of the packages; fails if one is missing
    check.py vtu FILE           cells of a .vtu by meshio
    check.py stl FILE...        surfaces by trimesh
    check.py make-labels FILE   makes a small label volume by nibabel and prints its content

All figures are computed from points and cells, never from metadata that Palpate wrote.
"""

import json
import sys

import meshio
import mujoco
import nibabel
import numpy
import scipy
import skfem
import trimesh


def versions():
    modules = (meshio, mujoco, trimesh, nibabel, numpy, scipy, skfem)
    return {module.__name__: module.__version__ for module in modules}


def hexahedron_volumes(corners):
    """Volumes of trilinear hexahedra, by two Gauss points per direction, which is exact.

    corners: cells x 8 x 3, in the order of VTK.
    """
    signs = numpy.array(
        [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1],
         [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], float
    )
    total = numpy.zeros(len(corners))
    for gauss in signs / numpy.sqrt(3.0):
        factors = 1.0 + signs * gauss
        slopes = numpy.empty((8, 3))
        for axis in range(3):
            others = numpy.delete(factors, axis, axis=1).prod(axis=1)
            slopes[:, axis] = signs[:, axis] * others / 8.0
        jacobian = numpy.einsum("nci,cj->nij", corners, slopes)
        total += numpy.linalg.det(jacobian)
    return total


def vtu(path):
    mesh = meshio.read(path)
    cells = mesh.cells_dict["hexahedron"]
    volumes = hexahedron_volumes(mesh.points[cells])
    regions = mesh.cell_data_dict["region"]["hexahedron"]
    written = mesh.cell_data_dict["volume_mm3"]["hexahedron"]
    displacement = mesh.point_data["displacement_mm"]
    return {
        "points": len(mesh.points),
        "cells": len(cells),
        "kinds": sorted(mesh.cells_dict),
        "unused_points": int(len(mesh.points) - len(numpy.unique(cells))),
        "low_mm": mesh.points.min(axis=0).tolist(),
        "high_mm": mesh.points.max(axis=0).tolist(),
        "region_volumes_mm3": [
            float(volumes[regions == r].sum()) for r in range(int(regions.max()) + 1)
        ],
        "worst_volume_difference_mm3": float(numpy.abs(volumes - written).max()),
        "largest_displacement_mm": float(numpy.abs(displacement).max()),
        "point_data": sorted(mesh.point_data),
        "cell_data": sorted(mesh.cell_data),
    }


def stl(paths):
    surfaces = {}
    for path in paths:
        mesh = trimesh.load_mesh(path)
        name = path.replace("\\", "/").rsplit("/", 1)[-1]
        surfaces[name] = {
            "triangles": len(mesh.faces),
            "watertight": bool(mesh.is_watertight),
            "wound_alike": bool(mesh.is_winding_consistent),
            "volume_mm3": float(mesh.volume),
        }
    return surfaces


def make_labels(path):
    """A box (1) with a ball in it (2), turned and shifted, in voxels that are no cubes."""
    shape = (40, 44, 30)
    size_mm = numpy.array([2.0, 2.0, 3.0])
    at = numpy.stack(numpy.meshgrid(*map(numpy.arange, shape), indexing="ij"), axis=-1)
    inside = [(at[..., a] >= 3) & (at[..., a] < shape[a] - 3) for a in range(3)]
    labels = numpy.zeros(shape, numpy.uint8)
    labels[inside[0] & inside[1] & inside[2]] = 1
    middle = (numpy.array(shape) - 1) / 2
    labels[numpy.linalg.norm((at - middle) * size_mm, axis=-1) < 22.0] = 2
    turn = numpy.radians(25.0)
    rotation = numpy.array(
        [[numpy.cos(turn), -numpy.sin(turn), 0], [numpy.sin(turn), numpy.cos(turn), 0], [0, 0, 1]]
    )
    affine = numpy.eye(4)
    affine[:3, :3] = rotation @ numpy.diag(size_mm)
    affine[:3, 3] = [-30.0, 12.0, 500.0]
    nibabel.save(nibabel.Nifti1Image(labels, affine), path)
    return read_labels(path)


def read_labels(path):
    image = nibabel.load(path)
    labels = numpy.asanyarray(image.dataobj)
    voxel = abs(numpy.linalg.det(image.affine[:3, :3]))
    present = [int(label) for label in numpy.unique(labels) if label != 0]
    centres = {
        label: nibabel.affines.apply_affine(image.affine, numpy.argwhere(labels == label))
        for label in present
    }
    return {
        str(label): {
            "volume_mm3": float(len(points) * voxel),
            "centre_mm": points.mean(axis=0).tolist(),
        }
        for label, points in centres.items()
    }


def main(command, *paths):
    commands = {
        "versions": lambda: versions(),
        "vtu": lambda: vtu(*paths),
        "stl": lambda: stl(paths),
        "make-labels": lambda: make_labels(*paths),
    }
    json.dump(commands[command](), sys.stdout)


main(*sys.argv[1:])
