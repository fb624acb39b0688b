//! A homogeneous rectangular block of cells: the simplest model, for closed-form checks and benchmarks.

use crate::cell::NO_CELL;
use crate::{Cell, Material, Model, Region, RegionId, Vec3};

/// A block of `cells[0] x cells[1] x cells[2]` cubes of side `spacing_m` with its low corner at the
/// origin. The lowest `pinned_layers` layers of cells along z form a region `base` that is pinned;
/// the rest is the region `body`.
pub fn block(
    cells: [usize; 3],
    spacing_m: f64,
    material: &Material,
    pinned_layers: usize,
) -> Model {
    let [nx, ny, nz] = cells;
    let node = |i: usize, j: usize, k: usize| (i + (nx + 1) * (j + (ny + 1) * k)) as u32;
    let cell = |i: usize, j: usize, k: usize| (i + nx * (j + ny * k)) as u32;
    let mut nodes = Vec::with_capacity((nx + 1) * (ny + 1) * (nz + 1));
    for k in 0..=nz {
        for j in 0..=ny {
            for i in 0..=nx {
                nodes.push(Vec3::new(i as f64, j as f64, k as f64) * spacing_m);
            }
        }
    }
    let lattice = nodes
        .iter()
        .map(|p| [p.x, p.y, p.z].map(|v| (v / spacing_m).round() as i32))
        .collect();
    let mut list = Vec::with_capacity(nx * ny * nz);
    for k in 0..nz {
        for j in 0..ny {
            for i in 0..nx {
                let at = [i, j, k];
                list.push(Cell {
                    corners: std::array::from_fn(|c| {
                        node(i + (c & 1), j + (c >> 1 & 1), k + (c >> 2 & 1))
                    }),
                    neighbours: std::array::from_fn(|face| {
                        let axis = face / 2;
                        let mut to = at;
                        if face % 2 == 1 {
                            to[axis] += 1;
                            if to[axis] == cells[axis] {
                                return NO_CELL;
                            }
                        } else if to[axis] == 0 {
                            return NO_CELL;
                        } else {
                            to[axis] -= 1;
                        }
                        cell(to[0], to[1], to[2])
                    }),
                    region: RegionId(u16::from(k >= pinned_layers)),
                });
            }
        }
    }
    let region = |name: &str, pinned| Region {
        name: name.into(),
        material: material.clone(),
        pinned,
        fibre: [0.0; 3],
    };
    let mut model = Model {
        spacing_m,
        gravity: [0.0; 3],
        regions: vec![region("base", true), region("body", false)],
        nodes,
        lattice,
        cells: list,
    };
    model.resolve_fibres();
    model
}
