//! The report of a build.

use serde::{Deserialize, Serialize};

use super::component_loss::ComponentLoss;
use super::contact_change::ContactReport;
use super::gaps::GapReport;
use super::surface_faults::SurfaceFault;
use super::thin::ThinParts;
use crate::surface::{Edges, Sets};

/// One object with the figures of a build.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BuildReport {
    /// Number of nodes (mass points).
    pub nodes: usize,
    /// Number of hexahedral cells.
    pub cells: usize,
    /// Springs by kind.
    pub springs: SpringCounts,
    /// Lattice spacing in mm.
    pub spacing_mm: f64,
    /// How the spacing was found, when the scene left it to the builder.
    #[serde(default)]
    pub spacing_search: Option<SpacingReport>,
    /// One entry per region, in scene order.
    pub regions: Vec<RegionReport>,
    /// One entry per interface.
    #[serde(default)]
    pub layers: Vec<LayerReport>,
    /// The outer surface.
    pub outer_surface: SurfaceReport,
    /// Shape quality of the cells.
    pub quality: QualityReport,
    /// One virtual bar per region that is not pinned: the modulus of its material and the modulus of the model.
    #[serde(default)]
    pub bars: Vec<BarReport>,
    /// Parts thinner than the spacing, and parts of the input that were lost.
    #[serde(default)]
    pub thin: ThinParts,
    /// Components of the input that were lost, or joined with others.
    #[serde(default)]
    pub component_loss: ComponentLoss,
    /// Pairs of regions that touch in the model where they do not in the input, or the reverse.
    #[serde(default)]
    pub contacts: Vec<ContactReport>,
    /// Gaps of the input that stay open although no cell is empty there.
    #[serde(default)]
    pub gaps: Vec<GapReport>,
    /// Places where the outer surface or that of a region is not closed or passes through itself or another one: the
    /// first ones of each surface.
    #[serde(default)]
    pub surface_faults: Vec<SurfaceFault>,
    /// Pairs of triangles that pass through each other of two surfaces without a region in common.
    #[serde(default)]
    pub surface_intersections: usize,
    /// Topology hash of the uncut model, hexadecimal.
    pub topology_hash: String,
    /// Number of warnings about faulty input surfaces, and about deviations beyond the thresholds of the scene.
    #[serde(default)]
    pub deviations: usize,
    /// Warnings for the user, one sentence each.
    pub warnings: Vec<String>,
}

/// Springs by kind (Lin 2007, fig. 3.2), each counted once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SpringCounts {
    /// Along the edges of cells, within a tissue or within an interface.
    pub structural: usize,
    /// Across the faces of cells.
    pub shear: usize,
    /// Through the bodies of cells.
    #[serde(default)]
    pub body_diagonal: usize,
    /// Along the edges that join an interface to the next layer of nodes on either side.
    pub layer: usize,
    /// Of the structural and shear ones, those within the mass-spring layer of an interface.
    #[serde(default)]
    pub within_interfaces: usize,
}

/// How an automatic spacing was found (Lin 2007, eq. 3.2).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SpacingReport {
    /// Distances between crossings of different interfaces that were measured along rays.
    pub distances: usize,
    /// The smallest of them in mm: in real data two surfaces that cross, hence near zero.
    pub smallest_mm: f64,
    /// The low quantile that stands for the smallest layer, `d_min`, in mm.
    pub quantile_mm: f64,
    /// Quantile of the distances that `d_min` is.
    pub quantile: f64,
    /// The least spacing that the scene allows, `d_threshold`, in mm.
    pub threshold_mm: f64,
    /// The least spacing that the limits of nodes and cells allow, in mm.
    pub memory_mm: f64,
}

/// A region of the model against its input surface.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RegionReport {
    /// Its name.
    pub name: String,
    /// Nodes of its cells, those on its interfaces included.
    pub nodes: usize,
    /// Volume of its cells in mm³.
    pub volume_mm3: f64,
    /// Volume of its input surface less what later regions take, in mm³.
    pub input_volume_mm3: f64,
    /// Dice coefficient of the region of the model and that of the input: twice the common volume over the sum of both.
    #[serde(default)]
    pub dice: f64,
    /// Volume that one of the two has and the other has not, in mm³.
    #[serde(default)]
    pub difference_mm3: f64,
    /// The same as a part of the input volume.
    #[serde(default)]
    pub difference_part: f64,
    /// Pieces of cells that share faces.
    #[serde(default)]
    pub components: usize,
    /// Its surface over the model's own nodes.
    #[serde(default)]
    pub surface: SurfaceReport,
    /// Connected components of its input, less what later regions take, without crumbs.
    #[serde(default)]
    pub input_components: usize,
    /// Further components, each below 1 mm³.
    #[serde(default)]
    pub input_crumbs: usize,
    /// Of these, those that the model has.
    #[serde(default)]
    pub input_crumbs_kept: usize,
    /// Mean distance of its surface from that of the same region of the input, in mm.
    pub surface_distance_mean_mm: f64,
    /// 99th percentile of it, by area.
    #[serde(default)]
    pub surface_distance_p99_mm: f64,
    /// Largest such distance, in mm.
    pub surface_distance_max_mm: f64,
    /// Mean distance of the surface of the input's region from that of the same region of the model, in mm. Like the
    /// next two it is left out where the model has nothing of the region.
    #[serde(default)]
    pub input_distance_mean_mm: Option<f64>,
    /// 99th percentile of it, by area.
    #[serde(default)]
    pub input_distance_p99_mm: Option<f64>,
    /// Largest such distance, in mm.
    #[serde(default)]
    pub input_distance_max_mm: Option<f64>,
    /// Mean distance of its interfaces from those of the input outside of thin parts, in mm: the larger one of the two
    /// directions.
    #[serde(default)]
    pub distance_mean_outside_thin_mm: f64,
    /// Largest distance in either direction outside of thin parts, in mm.
    #[serde(default)]
    pub distance_max_outside_thin_mm: f64,
}

/// A bar of cells cut out of a region and pulled.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BarReport {
    /// The region.
    pub region: String,
    /// Cells of the bar along each axis of the lattice; none when the region is too thin for a bar.
    pub cells: [usize; 3],
    /// The axis of the lattice along which it was pulled: 0, 1, 2 for x, y, z.
    pub axis: usize,
    /// Young's modulus of the material in that direction, in kPa.
    pub expected_kpa: f64,
    /// Young's modulus of the bar, in kPa; none without a bar or without an equilibrium.
    pub measured_kpa: Option<f64>,
    /// Poisson's ratio of the material in that direction: the mean over the directions across.
    #[serde(default)]
    pub expected_poisson: f64,
    /// Poisson's ratio of the bar.
    #[serde(default)]
    pub measured_poisson: Option<f64>,
}

/// The mass-spring layers of one interface.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LayerReport {
    /// The later one of the two regions.
    pub inside: String,
    /// The other one; `None` is the outside.
    pub outside: Option<String>,
    /// Nodes of all its layers.
    pub nodes: usize,
    /// Springs of all its layers.
    pub springs: usize,
    /// Layers: connected components of the interface.
    pub components: usize,
    /// Of these, components of less than a hundredth of the nodes: islands at thin places.
    pub small_components: usize,
}

/// A surface as a triangle mesh.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SurfaceReport {
    /// Number of vertices.
    pub vertices: usize,
    /// Number of triangles.
    pub triangles: usize,
    /// Whether every edge belongs to exactly two triangles.
    pub closed: bool,
    /// Edges that do not.
    #[serde(default)]
    pub edges_not_two: usize,
    /// Pairs of triangles of which an edge of one passes through the inside of the other.
    #[serde(default)]
    pub self_intersections: usize,
    /// Number of connected parts.
    pub components: usize,
}

/// Shape of the cells.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct QualityReport {
    /// Shortest spring in spacings.
    pub shortest_spring: f64,
    /// Cells that miss the builder's floors: a corner determinant of 0.01 Δd³, springs of 0.3 Δd.
    pub bad_cells: usize,
    /// Cells with a corner that is flat or inside out.
    pub inverted_cells: usize,
    /// The least determinant at a corner, in Δd³.
    #[serde(default)]
    pub least_corner: f64,
    /// Cells by their least scaled Jacobian: below 0.1, 0.1 to 0.2, ... 0.9 to 1.
    #[serde(default)]
    pub scaled_jacobian: [usize; 10],
    /// Nodes released from their surface so that their cells meet the quality floors, or so that no surface passes
    /// through itself.
    #[serde(default)]
    pub nodes_let_go: usize,
    /// Nodes that two interfaces claimed; the nearer interface got them.
    #[serde(default)]
    pub nodes_tied: usize,
    /// Cells given to another region because the surface of their region would have touched itself.
    #[serde(default)]
    pub cells_flipped: usize,
}

/// Counts the vertices, edges and parts of a surface, but not its self-intersections.
pub(crate) fn report_triangles(triangles: &[[u32; 3]]) -> SurfaceReport {
    let mut vertices: Vec<u32> = triangles.iter().flatten().copied().collect();
    vertices.sort_unstable();
    vertices.dedup();
    let slot = |v: u32| vertices.partition_point(|&w| w < v) as u32;
    let mut sets = Sets::new(vertices.len());
    let mut components = vertices.len();
    let mut edges_not_two = 0;
    for uses in Edges::of(triangles).each() {
        edges_not_two += usize::from(uses.len() != 2);
        components -= usize::from(sets.join(slot(uses[0].low), slot(uses[0].high)));
    }
    SurfaceReport {
        vertices: vertices.len(),
        triangles: triangles.len(),
        closed: edges_not_two == 0,
        edges_not_two,
        self_intersections: 0,
        components,
    }
}
