//! Validation of a model from outside, so that no later code can panic on it.

use crate::Model;
use crate::cell::{EDGES, FACES, NO_CELL};
use crate::material::{
    COMPRESS_LIMIT_RANGE, FIBRE_RATIO_RANGE, POISSON_RANGE, STIFFENING_RANGE, STRETCH_LIMIT_RANGE,
    TOUGHNESS_J_M2_RANGE,
};

/// Most nodes of a model. At 16 million a topology takes about 12 GiB; a file with more is rejected.
pub const NODES_MAX: usize = 16_000_000;
/// Most cells of a model; face numbers (six per cell) then fit 32 bits with room to spare.
pub const CELLS_MAX: usize = 16_000_000;
/// Most regions of a model, far more than a scene names by hand. More means a damaged file.
pub const REGIONS_MAX: usize = 1024;
/// Farthest lattice coordinate from the origin, so that products of coordinates fit 64 bits.
const LATTICE_MAX: u32 = 1 << 20;
/// Farthest node from the origin in m; anything beyond is a mistaken unit.
pub const POSITION_MAX_M: f64 = 1e4;
/// Range of lattice spacings in m: from a tenth of a micrometre to ten metres.
const SPACING_RANGE_M: std::ops::RangeInclusive<f64> = 1e-7..=10.0;
/// Largest gravity along an axis in m/s²; of the order of a centrifuge's.
const GRAVITY_MAX_M_S2: f64 = 1e3;
/// Range of Young's moduli in Pa: from looser than mucus to a hundred times diamond. The range keeps every
/// spring's stiffness finite in 32 bits.
const YOUNG_RANGE_PA: std::ops::RangeInclusive<f64> = 1e-3..=1e14;
/// Range of densities in kg/m³.
const DENSITY_RANGE_KG_M3: std::ops::RangeInclusive<f64> = 1e-3..=1e6;
/// Rounding tolerance of the square of a unit vector.
const FIBRE_TOLERANCE: f64 = 1e-9;
/// Range of the coefficients of friction.
const FRICTION_RANGE: std::ops::RangeInclusive<f64> = 0.0..=10.0;

/// The first defect of a model, as the rest of "the model …".
pub(crate) fn check(model: &Model) -> Result<(), String> {
    check_counts(model)?;
    if !SPACING_RANGE_M.contains(&model.spacing_m) {
        return Err(format!("has a spacing of {} m", model.spacing_m));
    }
    // Written so that a NaN fails.
    if !model.gravity.iter().all(|g| g.abs() <= GRAVITY_MAX_M_S2) {
        return Err(format!("has a gravity of {:?} m/s2", model.gravity));
    }
    check_regions(model)?;
    for (node, (p, l)) in model.nodes.iter().zip(&model.lattice).enumerate() {
        // Written so that a NaN fails.
        if !p.iter().all(|v| v.abs() <= POSITION_MAX_M) {
            return Err(format!(
                "has node {node} at {p:?}, farther than {POSITION_MAX_M} m from the origin"
            ));
        }
        if l.iter().any(|v| v.unsigned_abs() > LATTICE_MAX) {
            return Err(format!("has node {node} at lattice point {l:?}"));
        }
    }
    check_cells(model)
}

fn check_counts(model: &Model) -> Result<(), String> {
    for (what, count, max) in [
        ("nodes", model.nodes.len(), NODES_MAX),
        ("cells", model.cells.len(), CELLS_MAX),
        ("regions", model.regions.len(), REGIONS_MAX),
    ] {
        if count == 0 {
            return Err(format!("has no {what}"));
        }
        if count > max {
            return Err(format!("has {count} {what}; the limit is {max}"));
        }
    }
    if model.lattice.len() != model.nodes.len() {
        return Err("has a number of lattice points that differs from its nodes".into());
    }
    Ok(())
}

fn check_regions(model: &Model) -> Result<(), String> {
    for region in &model.regions {
        let m = &region.material;
        let fits = YOUNG_RANGE_PA.contains(&m.young_pa)
            && DENSITY_RANGE_KG_M3.contains(&m.density_kg_m3)
            && FRICTION_RANGE.contains(&m.friction_static)
            && FRICTION_RANGE.contains(&m.friction_dynamic)
            && within(TOUGHNESS_J_M2_RANGE, m.toughness_j_m2)
            && within(POISSON_RANGE, m.poisson)
            && within(STIFFENING_RANGE, m.stiffening)
            && within(FIBRE_RATIO_RANGE, m.fibre_ratio)
            && within(COMPRESS_LIMIT_RANGE, m.compress_limit)
            && within(STRETCH_LIMIT_RANGE, m.stretch_limit);
        if !fits {
            let (region, material) = (&region.name, &m.name);
            return Err(format!(
                "has in region `{region}` a material `{material}` with values out of range"
            ));
        }
        let squared: f64 = region.fibre.iter().map(|v| v * v).sum();
        let fibred = m.fibre_ratio != 1.0;
        let sound = if fibred {
            (squared - 1.0).abs() < FIBRE_TOLERANCE
        } else {
            region.fibre == [0.0; 3]
        };
        if !sound {
            let name = &region.name;
            return Err(format!(
                "has in region `{name}` fibres along {:?}",
                region.fibre
            ));
        }
    }
    Ok(())
}

fn within([low, high]: [f64; 2], value: f64) -> bool {
    (low..=high).contains(&value)
}

fn check_cells(model: &Model) -> Result<(), String> {
    let nodes = model.nodes.len();
    let mut slots = vec![0u8; nodes];
    for (index, cell) in model.cells.iter().enumerate() {
        if cell.region.index() >= model.regions.len() {
            return Err(format!("has cell {index} in a region that does not exist"));
        }
        for (corner, &node) in cell.corners.iter().enumerate() {
            let Some(slot) = slots.get_mut(node as usize) else {
                return Err(format!("has cell {index} on node {node} of {nodes}"));
            };
            if *slot >> corner & 1 == 1 {
                return Err(format!("has two cells in one position at node {node}"));
            }
            *slot |= 1 << corner;
        }
        for [a, b] in EDGES {
            let [from, to] = [a, b].map(|c| model.lattice[cell.corners[c] as usize]);
            let axis = (a ^ b).trailing_zeros() as usize;
            if (0..3).any(|i| to[i] - from[i] != i32::from(i == axis)) {
                return Err(format!("has cell {index} off the lattice"));
            }
        }
    }
    if let Some(node) = slots.iter().position(|&s| s == 0) {
        return Err(format!("has node {node} without a cell"));
    }
    check_neighbours(model)
}

fn check_neighbours(model: &Model) -> Result<(), String> {
    for (index, cell) in model.cells.iter().enumerate() {
        for (face, corners) in FACES.iter().enumerate() {
            let neighbour = cell.neighbours[face];
            if neighbour == NO_CELL {
                continue;
            }
            let wrong = || format!("has a wrong neighbour of cell {index} across face {face}");
            let other = model.cells.get(neighbour as usize).ok_or_else(wrong)?;
            let across = 1 << (face / 2);
            let shares = corners
                .iter()
                .all(|&c| cell.corners[c] == other.corners[c ^ across]);
            if !shares || other.neighbours[face ^ 1] != index as u32 {
                return Err(wrong());
            }
        }
    }
    Ok(())
}
