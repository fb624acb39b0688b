//! Validation of the input, and warnings about the result.

use palpate_tissue::limits::POSITION_MAX_M;
use palpate_tissue::{Model, Vec3};
use rayon::prelude::*;

use super::folds::{Fold, Folds};
use super::inside::PointQuery;
use super::lattice::Lattice;
use super::mending::Mending;
use super::{BUILD_NODES_MAX, GRID_CELLS_MAX};
use crate::scene::SceneInput;
use crate::surface::in_mm;
use crate::{Aabb, InputError, Surface};

/// Part of the cells of the grid that may be flipped without a warning.
const FLIPPED_WARNING: f64 = 0.005;

/// A region sticks out of the first one when it does so by more than this part of the spacing.
const STICKING_OUT: f64 = 0.25;

/// Extent in m above which an outermost surface was most likely not written in millimetres.
const LARGE: f64 = 5.0;
/// Extent in m below which an outermost surface was most likely written in metres.
const SMALL: f64 = 0.003;

/// Rejects input outside the allowed coordinates, and a spacing that exceeds the memory limits.
pub(super) fn size(surfaces: &[&Surface], spacing: f64) -> Result<(), InputError> {
    let bounds = Aabb::around(surfaces.iter().flat_map(|s| &s.vertices));
    let far = bounds.map_or(0.0, |b| b.min.abs().sup(&b.max.abs()).max());
    if far > POSITION_MAX_M {
        return Err(InputError::new(format_args!(
            "the input reaches {far:.0} m from the origin, where a model may reach {POSITION_MAX_M} m; \
             is its unit right? If it is in the frame of a site or a map, move it to the origin first"
        )));
    }
    let extent = bounds.map_or_else(Vec3::zeros, |b| b.extent());
    let cells: f64 = extent.iter().map(|e| (e / spacing).ceil() + 2.0).product();
    let volume = surfaces.iter().map(|s| s.volume()).fold(0.0, f64::max);
    let nodes = volume / spacing.powi(3);
    if cells <= GRID_CELLS_MAX && nodes <= BUILD_NODES_MAX {
        return Ok(());
    }
    let factor = (cells / GRID_CELLS_MAX).max(nodes / BUILD_NODES_MAX).cbrt();
    // Rounded up to the hundredth, with some room for the rim of the grid.
    let suggestion_mm = (spacing * 1e3 * factor * 1.02 * 100.0).ceil() / 100.0;
    let hint = if extent.max() > LARGE {
        format!(
            "; the input is {:.0} m across: was it written in millimetres and read as metres?",
            extent.max()
        )
    } else {
        String::new()
    };
    Err(InputError::new(format_args!(
        "a spacing of {} mm makes about {nodes:.0} nodes in a grid of {cells:.0} cells, above the \
         limits of {BUILD_NODES_MAX:.0} nodes and {GRID_CELLS_MAX:.0} cells; use spacing_mm = \
         {suggestion_mm:.2} or more{hint}",
        spacing * 1e3
    )))
}

/// Rejects regions that are farther from all others than it or they are across, and warns of regions beside the others and of
/// those that stick out of the first one.
pub(super) fn nesting(
    input: &SceneInput,
    spacing: f64,
    query: &PointQuery,
    warnings: &mut Vec<String>,
) -> Result<(), InputError> {
    if input.voxels_m3.iter().all(Option::is_some) {
        // Regions of one label volume: the first surface goes around the others by construction.
        return Ok(());
    }
    let name = |r: usize| input.scene.regions[r].name.clone();
    let boxes: Vec<Option<Aabb>> = input.surfaces.iter().map(Surface::aabb).collect();
    for (r, surface) in input.surfaces.iter().enumerate().skip(1) {
        let Some(own) = boxes[r] else { continue };
        let others = (0..boxes.len()).filter(|o| *o != r);
        let others: Vec<Aabb> = others.filter_map(|o| boxes[o]).collect();
        let gaps = others.iter().map(|b| gap(&own, b));
        let gap = gaps.fold(f64::INFINITY, f64::min);
        let ends = others.iter().flat_map(|b| [&b.min, &b.max]);
        let reach = Aabb::around(ends).map_or(0.0, |b| b.extent().max());
        if gap > reach.max(own.extent().max()) {
            let side = |a: usize| format!("{:.0}..{:.0}", own.min[a] * 1e3, own.max[a] * 1e3);
            let at = format!("x {}, y {}, z {} mm", side(0), side(1), side(2));
            return Err(InputError::new(format_args!(
                "region {:?} lies wholly outside the others (it spans {at}), and farther from them than it or they are \
                 across; check its unit and whether all files are in one frame",
                name(r)
            )));
        }
        if gap > spacing {
            warnings.push(format!(
                "region {:?} lies beside the others, {:.1} mm from box to box, as a part of its own; if that is not \
                 intended, check its unit and whether all files are in one frame",
                name(r),
                gap * 1e3
            ));
        }
        let out = sticking_out(input, spacing, query, r);
        let all = surface.triangles.len();
        // A region that is all outside stands beside the first one; that is intended.
        if out * 50 > all && out * 50 < all * 49 {
            warnings.push(format!(
                "{} % of the surface of region {:?} lies outside the outermost region {:?}; \
                 what sticks out becomes part of the model",
                100 * out / all,
                name(r),
                name(0)
            ));
        }
    }
    Ok(())
}

/// Warns of pieces of the model that gravity acts on and no pinned node holds.
pub(super) fn hanging(model: &Model, warnings: &mut Vec<String>) {
    let adrift = model.adrift_nodes();
    if adrift > 0 {
        warnings.push(format!(
            "{adrift} of {} nodes are joined to nothing that is pinned: they would fall for ever, \
             so gravity leaves them alone",
            model.nodes.len()
        ));
    }
}

/// Distance in m between two boxes.
fn gap(a: &Aabb, b: &Aabb) -> f64 {
    (a.min - b.max)
        .sup(&(b.min - a.max))
        .sup(&Vec3::zeros())
        .norm()
}

/// Triangles of region `r` that lie outside the first region by more than a part of the spacing. Areas that two
/// surfaces share, as a flat end, count as outside or not by rounding.
fn sticking_out(input: &SceneInput, spacing: f64, query: &PointQuery, r: usize) -> usize {
    let surface = &input.surfaces[r];
    let depth = spacing * STICKING_OUT;
    (0..surface.triangles.len())
        .into_par_iter()
        .filter(|&t| {
            let [a, b, c] = surface.corners(t);
            let Some(normal) = (b - a).cross(&(c - a)).try_normalize(0.0) else {
                return false;
            };
            !query.contains(0, (a + b + c) / 3.0 - normal * depth)
        })
        .count()
}

/// The error for a spacing at which no cell is left.
pub(super) fn too_coarse(surfaces: &[&Surface], spacing: f64) -> InputError {
    let boxes = surfaces.iter().filter_map(|s| s.aabb());
    let extent = boxes.map(|b| b.extent().max()).fold(0.0, f64::max);
    let hint = if extent < SMALL {
        "; that is very small: were the surfaces written in metres? Then set unit = \"m\""
    } else {
        ""
    };
    InputError::new(format_args!(
        "a spacing of {} mm is too coarse: no cell of that size is half full of any region (the model \
         is {:.2} mm across); use a smaller spacing_mm{hint}",
        spacing * 1e3,
        extent * 1e3
    ))
}

/// Warns of surfaces that overlap themselves or are inside out in part. Returns the regions of these, and those of
/// ambiguous surfaces.
pub(super) fn folds(
    input: &SceneInput,
    folds: &[(usize, Folds)],
    warnings: &mut Vec<String>,
) -> Vec<usize> {
    let mut faulty = input.faulty.clone();
    for (r, found) in folds {
        let name = &input.scene.regions[*r].name;
        let size = |fold: &Fold| {
            let percent = 100.0 * fold.volume / found.volume;
            let place = fold.bounds.map_or_else(String::new, |b| {
                format!(" from {} to {}", in_mm(&b.min), in_mm(&b.max))
            });
            format!("{:.0} mm³ ({percent:.1} %){place}", fold.volume * 1e9)
        };
        let [repeated, inverted] = found.reported();
        if repeated.is_some() || inverted.is_some() {
            faulty.push(*r);
        }
        if let Some(fold) = repeated {
            warnings.push(format!(
                "the surface of region {name:?} overlaps itself: {} lie inside it more than once; the model \
                 has the union; unite the parts in a mesh tool to be sure of the shape",
                size(&fold)
            ));
        }
        if let Some(fold) = inverted {
            warnings.push(format!(
                "the surface of region {name:?} is inside out in part: triangles around {} face inwards; the \
                 model fills this part too; is the surface twisted? Repair it and export it again",
                size(&fold)
            ));
        }
    }
    faulty.sort_unstable();
    faulty.dedup();
    faulty
}

/// Warns of changes to the labels.
pub(super) fn mending(
    mending: &Mending,
    lattice: &Lattice,
    cells: usize,
    warnings: &mut Vec<String>,
) {
    if mending.dropped.0 > 0 {
        warnings.push(format!(
            "{} small pieces with {} cells in all were dropped: they are too thin or too small at \
             this spacing",
            mending.dropped.0, mending.dropped.1
        ));
    }
    let flipped = mending.flipped_outer + mending.flipped_inner;
    if flipped as f64 > cells as f64 * FLIPPED_WARNING {
        warnings.push(format!(
            "{flipped} cells were given to another region where the surface of one would have \
             touched itself: the spacing is coarse for these shapes"
        ));
    }
    let pieces = lattice.pieces();
    if pieces > 1 {
        warnings.push(format!("the model is in {pieces} separate pieces"));
    }
}
