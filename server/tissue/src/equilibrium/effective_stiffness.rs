//! Effective stiffness of coarse elements: numerical coarsening (Kharevych et al. 2009) by local energy minimisation, as in
//! localised orthogonal decomposition (Målqvist and Peterseim 2014) with patches of one element.
//!
//! A trilinear element is stiffer than the tissue in it. It can not bend a stiff sheet over a soft layer, and it strains
//! cells on a curved surface when it only turns. The V-cycle corrects this on the nodes, but an element that a quick step
//! defers answers by its matrix alone. So it answers by the least energy with which its nodes follow corner displacements e
//! in the mean:
//!
//! ```text
//! ½ eᵀ K e = min ½ uᵀ A u,    Pᵀ M (u - P e) = 0
//! ```
//!
//! A is the stiffness of its bricks at rest (on coarser levels the effective stiffness of its children), P the trilinear
//! weights, and M the volumes of the nodes in a whole element of cubes. For such an element of one tissue uniform strain is exact
//! (patch test); see `nodal_stiffness`. Nodes of neighbours do not restrain an element, and fixed ones stay. Rigid motions give no
//! force, unless the element contains fixed nodes. On level 1, K is multiplied by [`SOFTER`]. Elements with nodes that a cut added
//! or moved, and all elements above them, answer by their Galerkin matrix times [`CUT_FACTOR`].

use pulp::Simd;

use super::matrix::{Corners, Matrix};

/// Trilinear displacements between elements of level 1 are still stiffer than the tissue. From 0.85 to 1 hands are most
/// accurate at 0.9; see DECISIONS.md.
pub(super) const SOFTER: f64 = 0.9;
/// Factor of the Galerkin matrices of elements that a cut changed. From 0.65 to 0.85 hands differ little; to condense these
/// elements makes a blade sample half as expensive again.
const CUT_FACTOR: f32 = 0.7;

/// Stiffness of a coarse element.
#[derive(Clone)]
pub(crate) struct Stiffness {
    /// Galerkin matrix, for the V-cycle.
    pub(super) matrix: Matrix,
    /// Effective stiffness; none if a cut changed the element.
    pub(super) condensed: Option<Matrix>,
    /// Whether it can move and turn rigidly without a force.
    pub(super) is_free: bool,
}

impl Stiffness {
    /// Forces in N of a deferred element for these displacements of the corners in m, times `factor`.
    #[inline(always)]
    pub(super) fn effective_force<S: Simd>(&self, simd: S, factor: f32, by: &Corners) -> Corners {
        const ALL: [u32; 8] = [0, 1, 2, 3, 4, 5, 6, 7];
        let (k, factor) = match &self.condensed {
            Some(k) => (k, factor),
            None => (&self.matrix, CUT_FACTOR * factor),
        };
        let mut force = if self.is_free {
            let strains = without_rigid_motion(by);
            without_rigid_motion(&k.multiply(simd, &ALL, &strains).corners())
        } else {
            k.multiply(simd, &ALL, by).corners()
        };
        for v in force.as_flattened_mut() {
            *v *= factor;
        }
        force
    }
}

/// Side of the element on which a corner is, along an axis.
#[inline(always)]
const fn side(corner: usize, axis: usize) -> f32 {
    if corner >> axis & 1 == 1 { 1.0 } else { -1.0 }
}

/// Values of the corners without their mean and their mean rotation about the middle.
#[inline(always)]
fn without_rigid_motion(by: &Corners) -> Corners {
    let (mut turn, mut mean) = ([0.0; 3], [0.0; 3]);
    for (c, v) in by.iter().enumerate() {
        let [x, y, z] = [side(c, 0), side(c, 1), side(c, 2)];
        for (mean, v) in mean.iter_mut().zip(v) {
            *mean += v / 8.0;
        }
        turn[0] += y * v[2] - z * v[1];
        turn[1] += z * v[0] - x * v[2];
        turn[2] += x * v[1] - y * v[0];
    }
    // Each axis has a moment of inertia of 16.
    let [a, b, c] = [turn[0] / 16.0, turn[1] / 16.0, turn[2] / 16.0];
    let mut rest = *by;
    for (corner, v) in rest.iter_mut().enumerate() {
        let [x, y, z] = [side(corner, 0), side(corner, 1), side(corner, 2)];
        v[0] -= mean[0] + b * z - c * y;
        v[1] -= mean[1] + c * x - a * z;
        v[2] -= mean[2] + a * y - b * x;
    }
    rest
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::super::hierarchy::{Hierarchy, Level};
    use super::super::quad::ZERO;
    use super::*;
    use crate::{Material, Topology, block};

    const CELL: f64 = 4e-3;

    fn forces(level: &Level, e: usize, by: &Corners) -> Corners {
        level.force(pulp::Scalar::new(), e as u32, by, Some(1.0))
    }

    fn work(forces: &Corners, by: &Corners) -> f32 {
        let pairs = forces.as_flattened().iter().zip(by.as_flattened());
        pairs.map(|(f, v)| f * v).sum()
    }

    fn corners(of: impl Fn([f32; 3]) -> [f32; 3]) -> Corners {
        std::array::from_fn(|c| {
            let [x, y, z] = of([side(c, 0), side(c, 1), side(c, 2)]);
            [x, y, z, 0.0]
        })
    }

    /// Level 1 of a block whose upper cells, from a height in cells on, are `contrast` times as stiff.
    fn layered(from: i32, contrast: f64) -> Hierarchy {
        let mut model = block([8, 8, 8], CELL, &Material::default(), 1);
        let mut stiff = model.regions[0].clone();
        stiff.material.young_pa *= contrast;
        stiff.pinned = false;
        let id = crate::RegionId(model.regions.len() as u16);
        model.regions.push(stiff);
        for cell in &mut model.cells {
            if model.lattice[cell.corners[0] as usize][2] >= from {
                cell.region = id;
            }
        }
        Hierarchy::new(&Topology::new(Arc::new(model)))
    }

    #[test]
    fn uniform_strain_of_uniform_tissue_costs_the_energy_of_the_matrix() {
        let hierarchy = layered(0, 1.0);
        let level = &hierarchy.levels[0];
        let e = level.corners.len() - 1;
        for axis in 0..3 {
            let by = corners(|at| std::array::from_fn(|a| if a == axis { at[a] } else { 0.0 }));
            let own = level.force(pulp::Scalar::new(), e as u32, &by, None);
            let [effective, own] = [work(&forces(level, e, &by), &by), work(&own, &by)];
            assert!(
                (effective / (SOFTER as f32 * own) - 1.0).abs() < 1e-3,
                "{axis}: {effective} {own}"
            );
        }
    }

    #[test]
    fn stiff_sheet_on_a_soft_layer_bends_but_does_not_stretch() {
        let hierarchy = layered(7, 40.0);
        let level = &hierarchy.levels[0];
        let e = level.corners.len() - 1;
        let part = |by: &Corners| {
            let own = level.force(pulp::Scalar::new(), e as u32, by, None);
            work(&forces(level, e, by), by) / work(&own, by)
        };
        // Bending about y moves the upper corners apart and the lower ones together.
        let bent = part(&corners(|[x, _, z]| [x * z, 0.0, 0.0]));
        let stretched = part(&corners(|[x, ..]| [x, 0.0, 0.0]));
        assert!(
            bent < 0.7 * SOFTER as f32 && stretched > 0.9 * SOFTER as f32,
            "{bent} {stretched}"
        );
    }

    /// 16-bit matrices of mixed tissue are exact under translations, but not quite symmetric: their forces do not balance.
    #[test]
    fn forces_balance_in_mixed_tissue_and_vanish_under_translations() {
        let mut model = block([8; 3], CELL, &Material::default(), 1);
        let mut stiff = model.regions[0].clone();
        stiff.material.young_pa *= 20.0;
        stiff.pinned = false;
        model.regions.push(stiff);
        for cell in model.cells.iter_mut().step_by(3) {
            cell.region = crate::RegionId(model.regions.len() as u16 - 1);
        }
        let hierarchy = Hierarchy::new(&Topology::new(Arc::new(model)));
        let largest = |force: &Corners| {
            let values = force.as_flattened().iter();
            values.fold(0.0f32, |most, v| most.max(v.abs()))
        };
        let shift = corners(|_| [1.0, -0.5, 0.7]);
        let strain = corners(|[x, y, z]| [x + 0.3 * y * z, 0.2 * x - z, 0.5 * x * y]);
        let mut free = 0;
        for level in &hierarchy.levels {
            for e in 0..level.corners.len() {
                if !level.matrices[level.matrix[e] as usize].is_free {
                    continue;
                }
                let [moved, strained] = [&shift, &strain].map(|by| forces(level, e, by));
                let sums = [0, 1, 2].map(|a| strained.iter().map(|f| f[a]).sum::<f32>());
                let rest = sums
                    .iter()
                    .fold(largest(&moved), |most, v| most.max(v.abs()));
                let all = largest(&strained);
                assert!(rest < 1e-5 * all, "{rest} of {all} N");
                free += 1;
            }
        }
        assert!(free > 0);
    }

    proptest! {
        /// Forces balance, do not know rigid motions, and push along no displacement; and they are at most those of the matrix.
        #[test]
        fn forces_balance_and_resist(
            x in prop::array::uniform24(-1.0..1.0f32), turn in prop::array::uniform3(-1.0..1.0f32),
            shift in prop::array::uniform3(-1.0..1.0f32),
        ) {
            let hierarchy = layered(5, 30.0);
            let mut by = [ZERO; 8];
            for (i, v) in x.iter().enumerate() {
                by[i / 3][i % 3] = *v;
            }
            let mut moved = by;
            for (c, v) in moved.iter_mut().enumerate() {
                let [x, y, z] = [side(c, 0), side(c, 1), side(c, 2)];
                v[0] += shift[0] + turn[1] * z - turn[2] * y;
                v[1] += shift[1] + turn[2] * x - turn[0] * z;
                v[2] += shift[2] + turn[0] * y - turn[1] * x;
            }
            for level in &hierarchy.levels {
                for e in 0..level.corners.len() {
                    let is_free = level.matrices[level.matrix[e] as usize].is_free;
                    let force = forces(level, e, &by);
                    let strains = if is_free { without_rigid_motion(&by) } else { by };
                    let own = level.force(pulp::Scalar::new(), e as u32, &strains, None);
                    let [energy, most] = [work(&force, &by), work(&own, &strains)];
                    prop_assert!(energy > 0.0 && energy <= 1.001 * most, "{energy} {most}");
                    let largest = force.as_flattened().iter().fold(0.0f32, |a, f| a.max(f.abs()));
                    if is_free {
                        for a in 0..3 {
                            let sum: f32 = force.iter().map(|f| f[a]).sum();
                            prop_assert!(sum.abs() < 1e-4 * largest);
                        }
                        for (f, g) in force.iter().flatten().zip(forces(level, e, &moved).as_flattened()) {
                            prop_assert!((f - g).abs() < 1e-4 * largest);
                        }
                    }
                }
            }
        }
    }
}
