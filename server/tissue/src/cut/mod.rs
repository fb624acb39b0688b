//! Cutting: a stroke of a blade parts the tissue (Lin 2007, chapter 5).
//!
//! Only captions and the abstract of that chapter survive; every algorithm here is a reconstruction. They state: nodes
//! near the cut are snapped onto it, doubled and displaced; no new elements are made; triangles along the cut show the
//! layers; a refinement follows; the width varies with depth.
//!
//! A cut is a SHEET of faces between cells on opposite sides of the surface that the blade swept. The
//! nodes of the sheet are snapped onto that surface, the cells are parted along the sheet, and every
//! node is doubled once per further *fan* of cells around it that can no longer be reached through
//! uncut faces. Nodes at the front of the cut, whose cells still hang together around it, stay
//! single. Cells, and with them material, are neither made nor lost; crossing cuts, continued cuts,
//! re-entry into an old cut and leaving through the surface are the same rule; each side of the cut
//! keeps the springs of its own cells, which are half of those that were in its plane.
//!
//! ```text
//! stroke.rs      motion of the blade      sheet_snap.rs     nodes onto the swept surface
//! ribbon.rs      the swept surface        refine.rs         relaxation of the nodes around
//! sheet.rs       the faces it opens       projections.rs    sound cells by projections
//! cell_fans.rs   cell groups at a node    soundness.rs      limits of cell distortion
//! cell_index.rs  cells near a cut         part.rs           doubling, opening, deriving
//! patch.rs       nodes around a sheet     width.rs          the width of a wound
//! freedom.rs     directions of a node     follow.rs         deformed shapes after a cut
//! interface.rs   interfaces as built      swept_surface.rs  distances from it
//! edge.rs        resistance of an edge    edge_search.rs    cells along an edge
//! stroke_tree.rs the surfaces of strokes  smoothing.rs      smooth walls
//! ```
//!
//! Everything runs in one order that depends on the topology and the stroke alone: the same strokes
//! in the same order give the same topology hash everywhere.

mod bounded_moves;
mod cell_fans;
mod cell_index;
mod components;
mod edge;
mod edge_search;
mod follow;
mod freedom;
mod interface;
mod part;
mod patch;
mod projections;
mod refine;
mod ribbon;
mod sheet;
mod sheet_snap;
mod smoothing;
mod soundness;
mod stroke;
mod stroke_part;
mod stroke_tree;
mod swept_surface;
mod to_rest;
pub(crate) mod trilinear;
mod width;

use std::collections::{BTreeSet, HashMap};

pub(crate) use cell_index::CutIndex;
pub use edge::{EdgeResistance, EdgeTrack, edge_resistance};
pub use follow::Moved;
pub(crate) use part::derive_around;
pub use stroke::{
    BLADE_DEPTH_MAX_M, BLADE_POINTS_MAX, BladePoint, CutStroke, STROKE_LENGTH_MAX_M,
    WOUND_WIDTH_MAX_M,
};
pub use stroke_part::StrokePart;
pub(crate) use stroke_tree::StrokeTree;
pub use swept_surface::SweptSurface;
pub use to_rest::{RestPoint, to_rest};
pub use width::REST_WIDTH_MAX;

use crate::limits::NODES_MAX;
use crate::{FaceId, RegionId, Topology};
use bounded_moves::Moves;
use freedom::Freedom;
use patch::Patch;
use projections::Projections;
use ribbon::Ribbon;
use sheet_snap::SheetNode;

/// Farthest a node's rest position may ever be from where the model was built, in spacings, however
/// many cuts pass; a node at this bound falls short of the next cut instead.
pub(crate) const DRIFT_MAX: f64 = 1.5;

/// Reasons for rejecting a stroke. The topology is then unchanged.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CutError {
    /// Nothing to part.
    #[error(
        "the stroke parts nothing: the tissue is already parted there, or the cut is narrower than \
         two cells"
    )]
    NothingNew,
    /// The blade is outside of the tissue.
    #[error("the blade passes through no tissue, or less deep than half a cell")]
    NoTissue,
    /// For the reason that the message states.
    #[error("{0}")]
    Rejected(String),
}

impl From<String> for CutError {
    fn from(reason: String) -> Self {
        Self::Rejected(reason)
    }
}

/// Result of a cut.
#[derive(Debug, Clone, PartialEq)]
pub struct CutOutcome {
    /// Version of the topology after it.
    pub version: u32,
    /// New nodes, each with the node it was doubled from; the new ones follow each other from the
    /// old node count on.
    pub doubled: Vec<(u32, u32)>,
    /// Nodes whose rest position moved, and where their displacement comes from; sorted.
    pub moved: Vec<Moved>,
    /// All nodes whose rest position, springs or mass may have changed, sorted; new ones included.
    pub touched: Vec<u32>,
    /// Cells with a corner that moved or was doubled, sorted.
    pub reshaped: Vec<u32>,
    /// Faces between cells that it opened; each added two faces to the boundary.
    pub faces_opened: usize,
    /// Nodes of the sheet that lie on the swept surface.
    pub nodes_snapped: usize,
    /// Nodes of the sheet that could not reach it without damaging a cell.
    pub nodes_short: usize,
    /// Connected components among the cells that touch the sheet: 1 while they are connected around the cut's front.
    /// See [`Topology::components`] for the whole.
    pub components_near: usize,
    /// The regions that it cut, sorted.
    pub regions_cut: Vec<RegionId>,
}

impl CutOutcome {
    /// Whether it is an undo, a redo or a reset instead of a cut.
    pub fn is_return(&self) -> bool {
        self.faces_opened == 0
    }

    /// The outcome of a change to other cuts: nodes at the end may be gone, then `doubled` is added, and nothing else moves in
    /// a shape.
    pub(crate) fn returned(version: u32, doubled: Vec<(u32, u32)>) -> Self {
        Self {
            version,
            doubled,
            moved: Vec::new(),
            touched: Vec::new(),
            reshaped: Vec::new(),
            faces_opened: 0,
            nodes_snapped: 0,
            nodes_short: 0,
            components_near: 0,
            regions_cut: Vec::new(),
        }
    }
}

/// Cuts a topology with a stroke. On an error the topology is untouched.
pub fn cut(topology: &mut Topology, stroke: &CutStroke) -> Result<CutOutcome, CutError> {
    let plan = Plan::of(topology, stroke)?;
    Ok(plan.apply(topology, stroke))
}

/// A cut that parts something.
pub(crate) struct Plan {
    /// The faces that it opens.
    sheet: Vec<FaceId>,
    nodes: Vec<SheetNode>,
}

impl Plan {
    /// Faces that a stroke opens, and their nodes.
    pub(crate) fn of(topology: &Topology, stroke: &CutStroke) -> Result<Self, CutError> {
        let spacing = topology.model.spacing_m;
        stroke.check(spacing)?;
        let crossed = sheet::crossed(topology, &Ribbon::swept(&stroke.points, spacing))?;
        let sheet = sheet::sheet(topology, crossed);
        if sheet.is_empty() {
            return Err(CutError::NothingNew);
        }
        let nodes = sheet_snap::sheet_nodes(topology, &sheet);
        // A node has at most eight cells, so it makes at most seven more nodes.
        if topology.node_count() + 7 * nodes.len() > NODES_MAX + NODES_MAX / 4 {
            return Err(CutError::Rejected(format!(
                "the model has {NODES_MAX} nodes, and a cut would need more; no further cut is possible"
            )));
        }
        Ok(Self { sheet, nodes })
    }

    /// Cuts the topology that the plan was made for.
    pub(crate) fn apply(self, topology: &mut Topology, stroke: &CutStroke) -> CutOutcome {
        let Self { sheet, mut nodes } = self;
        let before = topology.hashed();
        let ribbon = Ribbon::continued(&stroke.points, topology.model.spacing_m);
        let ids: Vec<u32> = nodes.iter().map(|n| n.node).collect();
        let fans = part::fans(topology, &sheet, &ids);
        let mut patch = Patch::around(topology, &ids);
        let half_widths = width::half_widths(&patch, stroke, &ribbon, &fans);
        patch.expect_opening(half_widths, &ribbon);
        let (moved, mut changed) = settle(topology, patch, &ribbon, &sheet, &mut nodes);
        let doubled = part::double(topology, &ids, &fans);
        part::open(topology, &sheet, &doubled);
        changed.extend(width::widen(topology, stroke, &ribbon, &nodes, &doubled));
        changed.extend(doubled.iter().flat_map(|d| [d.0, d.1]));
        let around = derive_around(topology, &changed);
        topology.rehash(&before, &changed, &around.cells);
        topology.version += 1;

        let mut at_sheet: Vec<u32> = nodes.iter().map(|n| n.node).collect();
        at_sheet.extend(doubled.iter().map(|d| d.0));
        let loose = nodes.iter().filter(|n| n.freedom != Freedom::Pinned);
        let nodes_short = loose.clone().filter(|n| n.short).count();
        let sides = sheet.iter().flat_map(|&f| [f, topology.behind(f)]);
        let regions: BTreeSet<RegionId> = sides.map(|f| topology.region(f.cell())).collect();
        CutOutcome {
            version: topology.version,
            moved,
            touched: around.nodes,
            reshaped: around.cells,
            faces_opened: sheet.len(),
            nodes_snapped: loose.count() - nodes_short,
            nodes_short,
            components_near: topology.components_among(&at_sheet),
            regions_cut: regions.into_iter().collect(),
            doubled,
        }
    }
}

/// Moves the nodes of the sheet onto the ribbon and the nodes around along; no node is doubled yet.
fn settle(
    topology: &mut Topology,
    mut patch: Patch,
    ribbon: &Ribbon,
    sheet: &[FaceId],
    nodes: &mut [SheetNode],
) -> (Vec<Moved>, BTreeSet<u32>) {
    sheet_snap::place(&mut patch, nodes, ribbon);
    smoothing::spread(topology, sheet, &mut patch, nodes, ribbon);
    patch.relax(topology);
    Projections::new(topology, ribbon, &mut patch, nodes).run();
    patch.backtrack();
    smoothing::tighten(&mut patch, nodes, ribbon);
    sheet_snap::mark(&patch, nodes, ribbon);
    let mut moves = Moves {
        topology,
        old: HashMap::new(),
    };
    for n in 0..patch.movable {
        if patch.at[n] != patch.start[n] {
            moves.old.insert(patch.ids[n], patch.start[n]);
            moves.topology.rest[patch.ids[n] as usize] = patch.at[n];
        }
    }
    (follow::moved(&moves), moves.old.keys().copied().collect())
}
