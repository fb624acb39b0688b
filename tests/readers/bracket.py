"""Forces on the end of the bracket in tests/src/experiments/validate/bracket.rs, by finite elements of scikit-fem.

    bracket.py HEIGHT REACH WIDTH PUSH YOUNG_OF_COLUMN YOUNG_OF_ARM POISSON [CELLS]

in SI units. Linear elasticity, hexahedra with quadratic displacements, CELLS (4, an even number) over the width. Prints the forces down
and along the arm in N.
"""

import json
import sys

import numpy
from skfem import Basis, ElementHex2, ElementVector, MeshHex, asm, condense, solve
from skfem.models.elasticity import lame_parameters, linear_elasticity
from skfem.utils import build_pc_diag, solver_iter_pcg

# Exact for quadratic displacements in rectangular elements.
ORDER = 5


def main(height, reach, width, push, column, arm, poisson, cells=4):
    def axis(length):
        return numpy.linspace(0.0, length, round(length / width * cells) + 1)

    box = MeshHex.init_tensor(axis(reach), axis(width), axis(height))
    middle = box.p[:, box.t].mean(axis=1)
    in_column = middle[0] < width
    mesh = box.restrict(numpy.nonzero(in_column | (middle[2] > height - width))[0])
    element = ElementVector(ElementHex2())
    basis = Basis(mesh, element, intorder=ORDER)
    is_column = mesh.p[:, mesh.t].mean(axis=1)[0] < width
    stiffness = 0
    for elements, young in ((is_column, column), (~is_column, arm)):
        part = Basis(mesh, element, intorder=ORDER, elements=numpy.nonzero(elements)[0])
        stiffness = stiffness + asm(linear_elasticity(*lame_parameters(young, poisson)), part)
    floor = basis.get_dofs(lambda x: numpy.isclose(x[2], 0.0))
    end = basis.get_dofs(lambda x: numpy.isclose(x[0], reach))
    x = basis.zeros()
    x[end.all("u^3")] = -push
    system = condense(stiffness, x=x, D=numpy.union1d(floor.all(), end.all()))
    x = solve(*system, solver=solver_iter_pcg(M=build_pc_diag(system[0]), rtol=1e-8))
    force = stiffness @ x
    return [-force[end.all("u^3")].sum(), force[end.all("u^1")].sum()]


json.dump(main(*map(float, sys.argv[1:8]), *map(int, sys.argv[8:])), sys.stdout)
