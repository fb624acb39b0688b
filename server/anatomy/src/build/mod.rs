//! From closed surfaces to a model: tri-ray node snapping (Lin 2007, section 3.3) and its completion.
//!
//! 1. A grid of cubes of side Δd is laid around the outermost surface.
//! 2. Rays decide which region fills each cell ([`label`]). Thin layers and necks get the cells that they need
//!    to stay connected ([`walls`], [`bridge`]). Doubtful cells are flipped until the surface of every region is a
//!    manifold ([`mending`]). Faces in gaps that no cell is empty for are opened ([`gaps`]).
//! 3. Nodes between regions are snapped onto the interface along rays in three directions; other interface
//!    nodes are projected onto it, and all are relaxed ([`snap`], [`relax`]).
//! 4. Cells are untangled until all meet the quality floors ([`untangle`]), faces are fitted to their interfaces, and
//!    regions regain the volume that straight faces have cut off ([`volume_correction`]). Triangles of interfaces that
//!    pass through each other are parted ([`parting`]), at gaps also before.
//! 5. The model is compared with its input ([`compare`]), and parts thinner than the spacing are listed with
//!    their position ([`interface_samples`], [`thin`]).
//!
//! Interfaces are then the faces between cells of different regions: closed and conforming by
//! construction.

mod bar;
mod bridge;
mod bvh;
mod compare;
mod component_loss;
mod components;
mod constraint;
mod contact_change;
mod deviations;
mod faces;
mod folds;
mod gaps;
mod grid;
mod input_check;
mod inside;
mod interface_samples;
mod interfaces;
mod label;
mod lattice;
mod layers;
mod mending;
mod occupancy_grid;
mod overlap;
mod parting;
mod parts;
mod quality;
mod rays;
mod region_distances;
mod region_surfaces;
mod relax;
mod report;
mod rim;
mod small_parts;
mod snap;
mod spacing;
mod strands;
mod surface_faults;
#[cfg(test)]
mod tests;
mod thin;
mod untangle;
mod volume_correction;
mod walls;

pub use component_loss::{
    COMPONENTS_MAX, CRUMB_MM3, ComponentLoss, ComponentReport, KEPT_MIN, LostCrumbs,
    MergedComponent,
};
pub use contact_change::ContactReport;
pub use gaps::GapReport;
pub use layers::{Layer, Layers, NEIGHBOURS_MAX, region_surface};
pub use quality::{CORNER_FLOOR, SPRING_FLOOR};
pub(crate) use report::report_triangles;
pub use report::{
    BarReport, BuildReport, LayerReport, QualityReport, RegionReport, SpacingReport, SpringCounts,
    SurfaceReport,
};
pub use surface_faults::{FaultKind, SurfaceFault};
pub use thin::{THIN_PARTS_MAX, ThinKind, ThinPart, ThinParts};

use crate::scene::{Scene, SceneInput};
use crate::{InputError, Surface};
use grid::Grid;
use palpate_tissue::cell::NO_CELL;
use palpate_tissue::{Model, TopologyHash, Vec3};
use parts::ClosedParts;

/// Most grid cells of one build. A cell of the grid costs about 10 bytes until nodes are placed, so
/// this is 4 GB; beyond it the build is rejected with the spacing that would fit.
pub const GRID_CELLS_MAX: f64 = 4e8;

/// Most nodes of one model. A node costs about 600 bytes with its springs, so this is 5 GB; beyond
/// it the build is rejected with the spacing that would fit.
pub const BUILD_NODES_MAX: f64 = 8e6;

/// A released node is reported when it is farther from its interface than this, in spacings.
const STRAY: f64 = 0.25;

/// Receives the name of each stage as it begins and the part of the work done (0..1).
pub type Progress<'a> = &'a mut dyn FnMut(&str, f64);

/// Builds a model from a scene and its surfaces.
pub fn build(
    input: &SceneInput,
    progress: Progress<'_>,
) -> Result<(Model, BuildReport), InputError> {
    let regions = input.scene.model_regions()?;
    let surfaces: Vec<&Surface> = input.surfaces.iter().collect();
    let mut warnings = input.warnings.clone();

    progress("measuring the input", 0.0);
    let (spacing, spacing_search) = spacing_of(&input.scene, &surfaces);
    input_check::size(&surfaces, spacing)?;
    let grid = Grid::around(&surfaces, spacing);
    let query = inside::PointQuery::new(&surfaces, grid.middle(), spacing);
    input_check::nesting(input, spacing, &query, &mut warnings)?;
    let mut walls = walls::Walls::default();
    let parts: Vec<ClosedParts> = surfaces.iter().map(|s| ClosedParts::of(s)).collect();
    let rays = overlap::InputRays::of(input, &grid, &surfaces, &parts, &query);
    let (mut input_volumes, folds) = label::resolved_volumes(&grid, &surfaces, &rays, &mut walls);
    let faulty = input_check::folds(input, &folds, &mut warnings);
    prefer_voxels(&mut input_volumes, input);

    progress("casting rays", 0.1);
    let (mut labels, parts_of) = label::label(&grid, &surfaces, &mut walls);
    let mending = mending::mend_all(&grid, &mut labels, &walls, &parts);
    let lost = walls.lost(&grid, &labels);

    progress("sorting the interfaces", 0.2);
    let interfaces =
        interfaces::Interfaces::new(&surfaces, &input.sides, &query, spacing, grid.middle());
    let joints = gaps::Joints {
        grid: &grid,
        labels: &labels,
        walls: &walls,
        parts: &parts_of,
        query: &query,
        fused: &input.scene.fuse,
    };
    let numbered = joints.number();
    let mut lattice = numbered.ok_or_else(|| input_check::too_coarse(&surfaces, spacing))?;
    let faces = faces::faces(&lattice.cells, &lattice.nodes);
    let placing = (&surfaces[..], &interfaces, &input_volumes[..]);
    let placed = position_nodes(&grid, &mut lattice, placing, &faces, progress);
    input_check::mending(&mending, &lattice, grid.cell_count(), &mut warnings);
    drop((labels, walls, parts_of, query));

    progress("looking for thin parts", 0.8);
    let samples = interface_samples::samples(&interfaces, &faces, &placed.positions, grid.middle());
    let mut collector = thin::Collector::of(&grid, &samples, &mending.crumbs, &lost, &parts);
    collector.add_nodes(&placed.strays(&lattice, &interfaces));
    let (around, tied, let_go) = (placed.around, placed.tied, placed.let_go.len());
    drop(placed.constraints);
    let mut model = Model {
        spacing_m: spacing,
        gravity: input.scene.gravity_m_s2,
        regions,
        nodes: placed.positions,
        lattice: lattice.nodes,
        cells: lattice.cells,
    };
    model.resolve_fibres();

    progress("comparing with the input", 0.9);
    let overlap = rays.compare(&model, &faces);
    let (regions, strays) = compare::regions(&compare::Compared {
        model: &model,
        around: &around,
        faces: &faces,
        interfaces: &interfaces,
        samples: &samples,
        thin: &collector,
        overlap: &overlap,
        input_volumes: &input_volumes,
    });
    collector.add_strays(&strays);
    let names: Vec<String> = regions.iter().map(|r| r.name.clone()).collect();
    input_check::hanging(&model, &mut warnings);
    let figures = figures(&model, &faces, &names);
    let mut report = BuildReport {
        nodes: model.nodes.len(),
        cells: model.cells.len(),
        layers: figures.layers,
        springs: compare::count_springs(&model, &around, &faces),
        spacing_mm: spacing * 1e3,
        spacing_search,
        regions,
        outer_surface: figures.outer_surface,
        quality: QualityReport {
            nodes_let_go: let_go,
            nodes_tied: tied,
            cells_flipped: mending.flipped_outer + mending.flipped_inner,
            ..compare::quality(&model)
        },
        bars: figures.bars,
        thin: collector.finish(&names),
        component_loss: component_loss::losses(&overlap.components, &names, &input.scene),
        contacts: contact_change::contacts(&grid, &samples, &faces, &model.nodes, &names),
        gaps: gaps::reports(&model, &lattice.opened),
        surface_faults: Vec::new(),
        surface_intersections: 0,
        topology_hash: figures.topology_hash,
        deviations: 0,
        warnings,
    };
    surface_faults::enter(&mut report, &model, &faces, &placed.crossing);
    deviations::warn(&mut report, &faulty, &input.scene);
    progress("done", 1.0);
    Ok((model, report))
}

/// The spacing in m, and how it was found if the scene leaves it to the builder.
fn spacing_of(scene: &Scene, surfaces: &[&Surface]) -> (f64, Option<SpacingReport>) {
    if scene.auto_spacing {
        let (spacing, search) = spacing::find(surfaces, scene.spacing_m);
        (spacing, Some(search))
    } else {
        (scene.spacing_m, None)
    }
}

/// A label volume is authoritative for the regions that it alone describes.
fn prefer_voxels(volumes: &mut [f64], input: &SceneInput) {
    for (volume, voxels) in volumes.iter_mut().zip(&input.voxels_m3) {
        *volume = voxels.unwrap_or(*volume);
    }
}

/// Figures of a report that follow from a finished model alone.
struct Figures {
    layers: Vec<LayerReport>,
    bars: Vec<BarReport>,
    outer_surface: SurfaceReport,
    topology_hash: String,
}

/// Computes them concurrently: each is mostly single-threaded.
fn figures(model: &Model, faces: &[faces::Face], names: &[String]) -> Figures {
    let layers = || compare::layers(&Layers::of_faces(model, faces), names);
    let outer_surface = || report_triangles(&outer_triangles(faces, model));
    let topology_hash = || TopologyHash::of_uncut(model).to_string();
    let ((layers, bars), (outer_surface, topology_hash)) = rayon::join(
        || rayon::join(layers, || bar::bars(model)),
        || rayon::join(outer_surface, topology_hash),
    );
    Figures {
        layers,
        bars,
        outer_surface,
        topology_hash,
    }
}

/// The outer surface over the model's nodes.
fn outer_triangles(faces: &[faces::Face], model: &Model) -> Vec<[u32; 3]> {
    let outside = |f: &&faces::Face| f.interface() == interfaces::Interface::Outer;
    let outer = faces.iter().filter(outside);
    outer.flat_map(|f| f.triangles(&model.nodes)).collect()
}

/// Positions of the nodes, and the record of their placement.
struct Placed {
    positions: Vec<Vec3>,
    constraints: Vec<constraint::Constraint>,
    /// The cells around each node.
    around: Vec<[u32; 8]>,
    /// Nodes that two interfaces claimed.
    tied: usize,
    /// Nodes released from their interface.
    let_go: Vec<u32>,
    /// The two faces of each pair of triangles that pass through each other.
    crossing: Vec<[u32; 2]>,
}

/// Snaps, relaxes, untangles, fits faces, restores volumes (m³), and parts crossing triangles.
fn position_nodes(
    grid: &Grid,
    lattice: &mut lattice::Lattice,
    (surfaces, interfaces, volumes): (&[&Surface], &interfaces::Interfaces, &[f64]),
    faces: &[faces::Face],
    progress: Progress<'_>,
) -> Placed {
    progress("snapping nodes", 0.3);
    let mut constraints = constraint::constraints(lattice);
    snap::mark_rims(grid, lattice, interfaces, &mut constraints);
    let tied = snap::settle_ties(grid, lattice, interfaces, &mut constraints);
    let mut positions = snap::snap(grid, lattice, surfaces, interfaces, &constraints);
    progress("relaxing", 0.4);
    relax::relax(lattice, interfaces, &constraints, &mut positions);
    // The axis neighbours are not used after this point.
    lattice.adjacent = Vec::new();
    progress("making cells good", 0.5);
    let untangler =
        untangle::Untangler::new(lattice, interfaces, &constraints, grid.spacing, grid.origin);
    let mut let_go = untangler.untangle(&mut positions);
    progress("restoring volumes", 0.7);
    let mut moved = Vec::new();
    if !lattice.opened.is_empty() {
        // Much has to be parted at gaps. The volumes that this takes can still be restored.
        moved = parting::part_crossings(&untangler, faces, &mut positions).moved;
    }
    volume_correction::restore_volumes(&untangler, faces, volumes, &mut positions);
    let parted = parting::part_crossings(&untangler, faces, &mut positions);
    moved.extend(parted.moved);
    let_go.extend((moved.into_iter()).filter(|node| !constraints[*node as usize].free()));
    let_go.sort_unstable();
    let_go.dedup();
    let around = untangler.into_around();
    Placed {
        positions,
        constraints,
        around,
        tied,
        let_go,
        crossing: parted.crossing,
    }
}

impl Placed {
    /// Released nodes that are off their interface: position, region, distance.
    fn strays(
        &self,
        lattice: &lattice::Lattice,
        interfaces: &interfaces::Interfaces,
    ) -> Vec<compare::Stray> {
        let strays = self.let_go.iter().filter_map(|&node| {
            let node = node as usize;
            let at = self.positions[node];
            let off = compare::off_interface(interfaces, self.constraints[node].interfaces(), &at);
            let cells = self.around[node].iter().filter(|c| **c != NO_CELL);
            let region = cells.map(|&c| lattice.cells[c as usize].region.0).max()?;
            (off > STRAY * interfaces.spacing).then_some((at, region, off))
        });
        strays.collect()
    }
}
