"""Forces on a cube between two glued plates, as in tests/src/experiments/validate/plates.rs, by elastic bodies of MuJoCo.

    plates.py SIDE DOWN ASIDE YOUNG POISSON [CELLS]

in SI units. The lower plate stays, the upper one moves by DOWN and ASIDE. CELLS (8, an even number) along each edge are cut into five
linear tetrahedra each, mirrored from cell to cell. The equilibrium is the shape in which the elastic forces of MuJoCo vanish on all
nodes that are not glued: Newton steps, whose linear systems are solved by conjugate gradients with differences of these forces. Prints
the forces on the upper plate, down and aside, in N.
"""

import json
import sys

import mujoco
import numpy

# Corners of a cell are numbered by 4 x + 2 y + z.
TETRAHEDRA = ((0, 3, 5, 6), (1, 0, 3, 5), (2, 0, 6, 3), (4, 0, 5, 6), (7, 3, 6, 5))
# Largest force on a free node over the norm of the forces on glued ones.
TOLERANCE = 1e-6
NEWTON_STEPS = 10
# Residual of a linear system over that of its start, and most iterations.
LINEAR = 1e-4
ITERATIONS = 2000
# Displacements in the differences of forces, over the side of the cube.
DIFFERENCE = 1e-7


def mesh(cells):
    """Nodes in units of a cell, and tetrahedra of positive volume."""
    axis = numpy.arange(cells + 1)
    nodes = numpy.stack(numpy.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    corners = numpy.array([[c >> 2 & 1, c >> 1 & 1, c & 1] for c in range(8)])
    lows = nodes[(nodes < cells).all(axis=1)]
    stride = numpy.array([(cells + 1) ** 2, cells + 1, 1])
    elements = []
    for parity in (0, 1):
        # A cell is mirrored in x, which turns its tetrahedra inside out.
        at = corners ^ numpy.array([parity, 0, 0])
        for a, b, c, d in TETRAHEDRA:
            u, v, w = (at[i] - at[a] for i in (b, c, d))
            order = (a, b, c, d) if numpy.linalg.det([u, v, w]) > 0 else (a, c, b, d)
            own = lows[lows.sum(axis=1) % 2 == parity]
            elements.append(((own[:, None, :] + at[list(order)]) * stride).sum(axis=2))
    return nodes, numpy.concatenate(elements)


def body(nodes, elements, young, poisson):
    def text(numbers):
        return " ".join(f"{n:.9g}" for n in numbers.ravel())

    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option gravity="0 0 0"/><size memory="1G"/><worldbody>
        <flexcomp name="cube" type="direct" dim="3" mass="1" radius="1e-4" point="{text(nodes)}" element="{text(elements)}">
        <elasticity young="{young}" poisson="{poisson}"/><contact contype="0" conaffinity="0" selfcollide="none"/>
        </flexcomp></worldbody></mujoco>"""
    )


def main(side, down, aside, young, poisson, cells=8):
    grid, elements = mesh(cells)
    height = grid[:, 2] / cells
    model = body(grid * (side / cells), elements, young, poisson)
    data = mujoco.MjData(model)
    is_free = numpy.repeat((grid[:, 2] > 0) & (grid[:, 2] < cells), 3)

    def forces(moved):
        data.qpos[:] = moved
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        return data.qfrc_spring.copy()

    def stiffness(moved, along):
        scale = DIFFERENCE * side / numpy.abs(along).max()
        step = scale * along
        return (forces(moved - step) - forces(moved + step)) / (2.0 * scale) * is_free

    moved = numpy.outer(height, [aside, 0.0, -down]).ravel()
    for _ in range(NEWTON_STEPS):
        force = forces(moved)
        rest = force * is_free
        if numpy.abs(rest).max() < TOLERANCE * numpy.linalg.norm(force[~is_free]):
            break
        correction, along = numpy.zeros_like(moved), rest.copy()
        square = start = rest @ rest
        for _ in range(ITERATIONS):
            image = stiffness(moved, along)
            share = square / (along @ image)
            correction += share * along
            rest -= share * image
            square, before = rest @ rest, square
            if square < LINEAR**2 * start:
                break
            along = rest + square / before * along
        moved += correction
    else:
        sys.exit("no equilibrium")
    # Springs pull against the force that holds the plate.
    x, _, z = -force.reshape(-1, 3)[height == 1.0].sum(axis=0)
    return [-z, x]


# MuJoCo would write its warnings into a file in the working directory.
mujoco.set_mju_user_warning(lambda text: print(text, file=sys.stderr))
json.dump(main(*map(float, sys.argv[1:6]), *map(int, sys.argv[6:])), sys.stdout)
