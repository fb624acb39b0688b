//! From closed surfaces to a model: tri-ray node snapping (Lin 2007, section 3.3) and its completion.
//!
//! 1. A grid of cubes of side Δd is laid around the outermost surface.
//! 2. Rays decide which region fills each cell ([`label`]); doubtful cells are flipped until the
//!    outer surface is a manifold ([`lattice`]).
//! 3. Nodes between regions are snapped onto the interface along rays in three directions, the rest
//!    is projected onto it, and all are relaxed ([`snap`], [`relax`]).
//! 4. What came out is compared with what went in ([`report`]).
//!
//! Interfaces are then the faces between cells of different regions: closed and conforming by
//! construction.

mod grid;
mod label;
mod lattice;
mod patch;
mod rays;
mod relax;
mod report;
mod rim;
mod snap;
#[cfg(test)]
mod tests;
mod volume;

use std::sync::Arc;

use thiserror::Error;

pub use report::{
    BuildReport, QualityReport, RegionReport, SpringCounts, SurfaceReport, report_surface,
};

use crate::scene::SceneInput;
use crate::{Model, Region, Surface, Topology, Vec3};
use grid::Grid;

/// Most grid cells of one build. A cell of the grid costs about 10 bytes while it is labelled, so
/// this is 4 GB; beyond it the build is refused with the spacing that would fit.
pub const GRID_CELLS_MAX: f64 = 4e8;

/// Most nodes of one model. A node costs about 600 bytes with its springs, so this is 5 GB; beyond
/// it the build is refused with the spacing that would fit.
pub const BUILD_NODES_MAX: f64 = 8e6;

/// A region whose volume differs from its input by more than this part earns a warning.
const VOLUME_WARNING: f64 = 0.02;

/// A region sticks out of the first one where it does so by more than this part of the spacing.
const STICKING_OUT: f64 = 0.25;

/// Why a model could not be built.
#[derive(Debug, Error)]
pub enum BuildError {
    /// A material of the scene is unknown or out of range.
    #[error(transparent)]
    Scene(#[from] crate::scene::SceneError),
    /// The spacing is too fine for the memory limits.
    #[error(
        "a spacing of {spacing_mm} mm makes about {nodes:.0} nodes in a grid of {cells:.0} cells, \
         above the limits of {BUILD_NODES_MAX:.0} nodes and {GRID_CELLS_MAX:.0} cells; \
         use spacing_mm = {suggestion_mm:.2} or more"
    )]
    TooFine {
        /// The spacing asked for.
        spacing_mm: f64,
        /// Nodes it would make.
        nodes: f64,
        /// Grid cells it would need.
        cells: f64,
        /// A spacing that fits.
        suggestion_mm: f64,
    },
    /// No cell is at least half full.
    #[error(
        "a spacing of {spacing_mm} mm is too coarse: no cell of that size is half full of any \
         region (the model is {extent_mm:.1} mm across); use a smaller spacing_mm"
    )]
    TooCoarse {
        /// The spacing asked for.
        spacing_mm: f64,
        /// Smallest extent of the outermost surface.
        extent_mm: f64,
    },
    /// A region has nothing in common with the first one.
    #[error(
        "region {region:?} lies wholly outside the outermost region {outermost:?} (it spans {at}); \
         check the units and the order: the first region must contain the others"
    )]
    Outside {
        /// The region.
        region: String,
        /// The first region.
        outermost: String,
        /// Its bounding box in words.
        at: String,
    },
}

/// Receives the name of each stage as it begins and the part of the work done (0..1).
pub type Progress<'a> = &'a mut dyn FnMut(&str, f64);

/// Builds a model from a scene and its surfaces.
pub fn build(
    input: &SceneInput,
    progress: Progress<'_>,
) -> Result<(Model, BuildReport), BuildError> {
    let regions = input.scene.model_regions()?;
    let surfaces: Vec<&Surface> = input.surfaces.iter().collect();
    let spacing = input.scene.spacing_m;
    let mut warnings = input.warnings.clone();

    progress("measuring the input", 0.0);
    check_size(&surfaces, spacing)?;
    let grid = Grid::around(&surfaces, spacing);
    let query = label::PointQuery::new(&surfaces);
    check_nesting(input, &query, &mut warnings)?;
    let mut input_volumes = label::resolved_volumes(&grid, &surfaces);
    for (volume, voxels) in input_volumes.iter_mut().zip(&input.voxels_m3) {
        // A label volume is the truth about what it alone describes.
        *volume = voxels.unwrap_or(*volume);
    }

    progress("casting rays", 0.1);
    let mut labels = label::label(&grid, &surfaces);
    let mut mending = lattice::mend(&grid, &mut labels);
    lattice::drop_crumbs(&grid, &mut labels, &mut mending);
    warn_mending(&mending, &mut warnings);
    let lattice = lattice::number(&grid, &labels);
    drop(labels);
    if lattice.cells.is_empty() {
        let extent = grid.cells.map(|n| n - 2).into_iter().min().unwrap_or(0) as f64 * spacing;
        return Err(BuildError::TooCoarse {
            spacing_mm: spacing * 1e3,
            extent_mm: extent * 1e3,
        });
    }

    progress("sorting the interfaces", 0.25);
    let interfaces = patch::Interfaces::new(&surfaces, &query, spacing);
    progress("snapping nodes", 0.35);
    let mut constraints = snap::constraints(&lattice);
    snap::mark_rims(&grid, &lattice, &interfaces, &mut constraints);
    let mut positions = snap::snap(&grid, &lattice, &surfaces, &interfaces, &constraints);
    progress("relaxing", 0.5);
    relax::relax(&lattice, &interfaces, &constraints, &mut positions);
    relax::mend_cells(&lattice, &interfaces, &constraints, spacing, &mut positions);
    volume::restore_volumes(
        &lattice,
        &constraints,
        &input_volumes,
        spacing,
        &mut positions,
    );

    progress("assembling springs", 0.75);
    let model = Arc::new(assemble(input, regions, lattice, positions));
    let topology = Topology::new(Arc::clone(&model));
    progress("comparing with the input", 0.9);
    let report = report(&model, &topology, &interfaces, &input_volumes, warnings);
    drop(topology);
    progress("done", 1.0);
    Ok((Arc::unwrap_or_clone(model), report))
}

fn check_size(surfaces: &[&Surface], spacing: f64) -> Result<(), BuildError> {
    let mut low = Vec3::repeat(f64::INFINITY);
    let mut high = Vec3::repeat(f64::NEG_INFINITY);
    for v in surfaces.iter().flat_map(|s| &s.vertices) {
        low = low.inf(v);
        high = high.sup(v);
    }
    let extent = high - low;
    let cells: f64 = extent.iter().map(|e| (e / spacing).ceil() + 2.0).product();
    let volume = surfaces.iter().map(|s| s.volume()).fold(0.0, f64::max);
    let nodes = volume / spacing.powi(3);
    if cells <= GRID_CELLS_MAX && nodes <= BUILD_NODES_MAX {
        return Ok(());
    }
    let factor = (cells / GRID_CELLS_MAX).max(nodes / BUILD_NODES_MAX).cbrt();
    // Rounded up to the hundredth, with a little room for the rim of the grid.
    let suggestion_mm = (spacing * 1e3 * factor * 1.02 * 100.0).ceil() / 100.0;
    Err(BuildError::TooFine {
        spacing_mm: spacing * 1e3,
        nodes,
        cells,
        suggestion_mm,
    })
}

/// Refuses regions that have nothing in common with the first, and warns of those that leave it.
fn check_nesting(
    input: &SceneInput,
    query: &label::PointQuery<'_>,
    warnings: &mut Vec<String>,
) -> Result<(), BuildError> {
    if input.voxels_m3.iter().all(Option::is_some) {
        // Regions of one label volume: the first surface goes around the others by construction.
        return Ok(());
    }
    let name = |r: usize| input.scene.regions[r].name.clone();
    for (r, surface) in input.surfaces.iter().enumerate().skip(1) {
        let outside = surface
            .vertices
            .iter()
            .filter(|v| !query.contains(0, **v))
            .count();
        if outside == surface.vertices.len() && !overlaps(input, query, r) {
            let mut low = Vec3::repeat(f64::INFINITY);
            let mut high = Vec3::repeat(f64::NEG_INFINITY);
            for v in &surface.vertices {
                low = low.inf(v);
                high = high.sup(v);
            }
            let side = |a: usize| format!("{:.0}..{:.0}", low[a] * 1e3, high[a] * 1e3);
            let at = format!("x {}, y {}, z {} mm", side(0), side(1), side(2));
            return Err(BuildError::Outside {
                region: name(r),
                outermost: name(0),
                at,
            });
        }
        let out = sticking_out(input, query, r);
        if out * 50 > surface.triangles.len() {
            warnings.push(format!(
                "{} % of the surface of region {:?} lies outside the outermost region {:?}; \
                 what sticks out becomes part of the model",
                100 * out / surface.triangles.len(),
                name(r),
                name(0)
            ));
        }
    }
    Ok(())
}

/// Triangles of region `r` that lie outside the first region by more than a part of the spacing:
/// what two surfaces have in common, as a flat end, counts as outside or not by rounding.
fn sticking_out(input: &SceneInput, query: &label::PointQuery<'_>, r: usize) -> usize {
    let surface = &input.surfaces[r];
    let depth = input.scene.spacing_m * STICKING_OUT;
    (0..surface.triangles.len())
        .filter(|&t| {
            let [a, b, c] = surface.corners(t);
            let Some(normal) = (b - a).cross(&(c - a)).try_normalize(0.0) else {
                return false;
            };
            !query.contains(0, (a + b + c) / 3.0 - normal * depth)
        })
        .count()
}

/// Whether some vertex of the first region lies within region `r`, or a triangle's middle of `r`
/// within the first.
fn overlaps(input: &SceneInput, query: &label::PointQuery<'_>, r: usize) -> bool {
    let first = &input.surfaces[0];
    let surface = &input.surfaces[r];
    first.vertices.iter().any(|v| query.contains(r, *v))
        || (0..surface.triangles.len()).any(|t| {
            let [a, b, c] = surface.corners(t);
            query.contains(0, (a + b + c) / 3.0)
        })
}

fn warn_mending(mending: &lattice::Mending, warnings: &mut Vec<String>) {
    if mending.dropped.0 > 0 {
        warnings.push(format!(
            "{} small pieces with {} cells in all were dropped: they are too thin or too small at \
             this spacing",
            mending.dropped.0, mending.dropped.1
        ));
    }
    if mending.flipped > 0 {
        warnings.push(format!(
            "{} cells were filled or emptied where the outer surface would have touched itself",
            mending.flipped
        ));
    }
    if mending.pieces > 1 {
        warnings.push(format!(
            "the model is in {} separate pieces",
            mending.pieces
        ));
    }
}

fn assemble(
    input: &SceneInput,
    regions: Vec<Region>,
    lattice: lattice::Lattice,
    nodes: Vec<Vec3>,
) -> Model {
    let at = lattice.nodes.iter().map(|p| p.map(|i| i as i32)).collect();
    Model {
        spacing_m: input.scene.spacing_m,
        regions,
        nodes,
        lattice: at,
        cells: lattice.cells,
    }
}

fn report(
    model: &Model,
    topology: &Topology,
    interfaces: &patch::Interfaces,
    input_volumes: &[f64],
    mut warnings: Vec<String>,
) -> BuildReport {
    let regions = report::report_regions(model, topology, interfaces, input_volumes);
    for region in &regions {
        let error = region.volume_mm3 / region.input_volume_mm3 - 1.0;
        if region.nodes == 0 {
            warnings.push(format!(
                "region {:?} has no cell at this spacing: it is thinner than half of it everywhere",
                region.name
            ));
        } else if error.abs() > VOLUME_WARNING {
            warnings.push(format!(
                "region {:?} has {:+.1} % of its input volume too much or too little; parts of it \
                 are thinner than the spacing",
                region.name,
                100.0 * error
            ));
        }
    }
    let quality = report::report_quality(model, topology);
    BuildReport {
        nodes: model.nodes.len(),
        cells: model.cells.len(),
        springs: report::count_springs(model, topology),
        spacing_mm: model.spacing_m * 1e3,
        regions,
        outer_surface: report_surface(topology.boundary()),
        quality,
        topology_hash: topology.hash().to_string(),
        warnings,
    }
}
