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
//! ribbon.rs      the swept surface        bounded_moves.rs  limits of cell distortion
//! sheet.rs       the faces it opens       refine.rs         relaxation of the nodes around
//! cell_fans.rs   cell groups at a node    part.rs           doubling, opening, deriving
//! cell_index.rs  cells near a cut         follow.rs         deformed shapes after a cut
//! ```
//!
//! Everything runs in one order that depends on the topology and the stroke alone: the same strokes
//! in the same order give the same topology hash everywhere.

mod bounded_moves;
mod cell_fans;
mod cell_index;
mod components;
mod follow;
mod part;
mod refine;
mod ribbon;
mod sheet;
mod sheet_snap;
mod stroke;
mod to_rest;
mod trilinear;
mod width;

use std::collections::{BTreeSet, HashMap};

pub(crate) use cell_index::CutIndex;
pub use follow::Moved;
pub(crate) use part::derive_around;
pub use stroke::{
    BLADE_DEPTH_MAX_M, BLADE_POINTS_MAX, BladePoint, CutStroke, STROKE_LENGTH_MAX_M,
    WOUND_WIDTH_MAX_M,
};
pub use to_rest::{RestPoint, to_rest};

use crate::limits::NODES_MAX;
use crate::{RegionId, Topology};
use bounded_moves::Moves;
use refine::Surroundings;
use ribbon::Ribbon;
use sheet_snap::{Freedom, SheetNode};

/// Farthest a node's rest position may ever be from where the model was built, in spacings, however
/// many cuts pass; a node at this bound falls short of the next cut instead.
pub(crate) const DRIFT_MAX: f64 = 1.0;
/// Retries of nodes that fell short while their surroundings yield.
const RETRIES: usize = 3;

/// Reasons for rejecting a stroke. The topology is then unchanged.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CutError {
    /// Nothing to part.
    #[error(
        "the stroke parts nothing: the tissue is already parted there, or the cut is narrower than \
         two cells"
    )]
    NothingNew,
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

/// Cuts a topology with a stroke. On an error the topology is untouched.
pub fn cut(topology: &mut Topology, stroke: &CutStroke) -> Result<CutOutcome, CutError> {
    let spacing = topology.model.spacing_m;
    stroke.check(spacing)?;
    let crossed = sheet::crossed(topology, &Ribbon::swept(&stroke.points, spacing))?;
    let sheet = sheet::sheet(topology, crossed);
    if sheet.is_empty() {
        return Err(CutError::NothingNew);
    }
    let mut nodes = sheet_snap::sheet_nodes(topology, &sheet);
    // A node has at most eight cells, so it makes at most seven more nodes.
    if topology.node_count() + 7 * nodes.len() > NODES_MAX + NODES_MAX / 4 {
        return Err(CutError::Rejected(format!(
            "the model has {NODES_MAX} nodes, and a cut would need more; no further cut is possible"
        )));
    }

    // All checks are done; nothing fails from here on.
    let ribbon = Ribbon::continued(&stroke.points, spacing);
    let (moved, mut changed) = settle(topology, &ribbon, &mut nodes);
    let doubled = part::double(topology, &sheet);
    part::open(topology, &sheet, &doubled);
    changed.extend(width::widen(topology, stroke, &ribbon, &doubled));
    changed.extend(doubled.iter().flat_map(|d| [d.0, d.1]));
    let touched = derive_around(topology, &changed);
    topology.version += 1;

    let mut around: Vec<u32> = nodes.iter().map(|n| n.node).collect();
    around.extend(doubled.iter().map(|d| d.0));
    let loose = nodes.iter().filter(|n| n.freedom != Freedom::Pinned);
    let nodes_short = loose.clone().filter(|n| n.short).count();
    let sides = sheet.iter().flat_map(|&f| [f, topology.behind(f)]);
    let regions: BTreeSet<RegionId> = sides.map(|f| topology.region(f.cell())).collect();
    Ok(CutOutcome {
        version: topology.version,
        moved,
        touched,
        faces_opened: sheet.len(),
        nodes_snapped: loose.count() - nodes_short,
        nodes_short,
        components_near: topology.components_among(&around),
        regions_cut: regions.into_iter().collect(),
        doubled,
    })
}

/// Moves the nodes of the sheet onto the ribbon, then relaxes the surroundings; no node is doubled yet.
fn settle(
    topology: &mut Topology,
    ribbon: &Ribbon,
    nodes: &mut [SheetNode],
) -> (Vec<Moved>, BTreeSet<u32>) {
    let mut ids: Vec<u32> = nodes.iter().map(|n| n.node).collect();
    ids.sort_unstable();
    let surroundings = Surroundings::of(topology, &ids);
    let mut moves = Moves {
        topology,
        old: HashMap::new(),
    };
    sheet_snap::snap(&mut moves, ribbon, nodes);
    for _ in 0..RETRIES {
        surroundings.relax(&mut moves);
        sheet_snap::retry(&mut moves, ribbon, nodes);
    }
    surroundings.relax(&mut moves);
    (follow::moved(&moves), moves.old.keys().copied().collect())
}
