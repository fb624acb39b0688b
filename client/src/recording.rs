//! Recording of a run as JSON, for comparisons between sites.
//!
//! All lists are bounded; [`Dropped`] counts the excess.

use nalgebra::Vector3;
use palpate_device::{Buttons, Pose};
use palpate_protocol::ClientTime;
use palpate_site::{OperationRecord, ToolAt, ViewFrame};
use palpate_tissue::Shape;
use serde::{Deserialize, Serialize};

/// Maximum points of the hand: 20 minutes of every fourth tick. Later ones are dropped and counted.
pub const HAPTIC_POINTS_MAX: usize = 300_000;

/// Maximum views: 20 minutes at [`VIEW_HZ`]. Later ones are dropped and counted.
pub const VIEWS_MAX: usize = 60_000;

/// Maximum nodes of all views together, 16 B each. Later views have no nodes and are counted.
pub const VIEW_NODES_MAX: usize = 4_000_000;

/// Maximum recording rate of views, Hz: every n-th of the common grid, the same ones at every site.
pub const VIEW_HZ: u32 = 50;

/// Maximum nodes per view. If more moved, those with the smallest [`node_rank`] are kept, the same at every site.
pub const NODES_PER_VIEW_MAX: usize = 512;

/// Minimum displacement of a recorded node, mm.
pub const NODE_MOVED_MM: f64 = 0.05;

/// Maximum operations: the log of a long session. Later ones are dropped and counted.
pub const OPERATIONS_MAX: usize = 100_000;

/// One run of one participant. Times in µs: `t_us`, `shown_us` and `applied_us` on the machine's monotonic clock,
/// `s_us` and `at_us` on the server's.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Recording {
    /// The participant's name.
    pub name: String,
    /// The participant's number.
    pub participant: u16,
    /// Word of the role.
    pub role: String,
    /// Start of the script on the monotonic clock; `None` if it did not start.
    pub script_started_us: Option<i64>,
    /// The hand: every fourth tick of the force loop, and each change of buttons.
    pub haptic: Vec<HapticPoint>,
    /// Displayed views.
    pub views: Vec<ViewRecord>,
    /// Applied operations, in order.
    pub operations: Vec<OperationRecord>,
    /// Counts of dropped items.
    pub dropped: Dropped,
}

/// The hand at one time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HapticPoint {
    /// Time, monotonic.
    pub t_us: i64,
    /// Position of the tool, m.
    pub position_m: [f64; 3],
    /// Orientation of the tool: x, y, z, w of a unit quaternion.
    pub orientation: [f64; 4],
    /// Held buttons, one bit each; bit 0 cuts.
    pub buttons: u32,
    /// The force on the tool, N.
    pub force_n: [f64; 3],
}

impl HapticPoint {
    /// A point from a sample of the device and the force on the tool, N.
    pub fn new(t_us: i64, pose: &Pose, buttons: Buttons, force_n: Vector3<f64>) -> Self {
        let q = pose.orientation;
        Self {
            t_us,
            position_m: pose.position.into(),
            orientation: [q.i, q.j, q.k, q.w],
            buttons: buttons.bits(),
            force_n: force_n.into(),
        }
    }
}

/// One view.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewRecord {
    /// Time that it shows, server clock.
    pub s_us: i64,
    /// Time of display, monotonic.
    pub shown_us: i64,
    /// Artificial delay D at that time.
    pub delay_us: i64,
    /// All tools, including this participant's own.
    pub tools: Vec<ToolRecord>,
    /// Node number and displacement x, y, z in mm.
    pub nodes: Vec<(u32, f32, f32, f32)>,
    /// Version of the topology.
    pub topology_version: u32,
}

impl ViewRecord {
    /// The record of a view that was shown at a time.
    pub fn new(frame: &ViewFrame, shape: &Shape, topology_version: u32, shown: ClientTime) -> Self {
        let moved = shape.displacement.iter().enumerate();
        let tool = |t: &ToolAt| ToolRecord {
            participant: t.participant.0,
            position_m: t.position.into(),
            stale: t.strength == 0.0,
            inserted: t.is_inserted(),
        };
        Self {
            s_us: frame.s.as_micros(),
            shown_us: shown.as_micros(),
            delay_us: frame.delay.as_micros(),
            tools: frame.tools.iter().map(tool).collect(),
            nodes: choose_nodes(moved.map(|(n, u)| (n as u32, (*u).into()))),
            topology_version,
        }
    }
}

/// A tool in a view.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ToolRecord {
    /// Participant that holds it.
    pub participant: u16,
    /// Position, m.
    pub position_m: [f64; 3],
    /// Whether its newest sample is too old to press.
    pub stale: bool,
    /// Whether it is a needle in the tissue.
    pub inserted: bool,
}

/// Counts of dropped items.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Dropped {
    /// Points of the hand.
    pub haptic: u64,
    /// Views.
    pub views: u64,
    /// Views without their nodes.
    pub view_nodes: u64,
    /// Operations.
    pub operations: u64,
}

/// Pseudo-random order of nodes, independent of position: the finaliser of `SplitMix64` (Steele, Lea and Flood 2014).
pub fn node_rank(node: u32) -> u64 {
    let mut z = u64::from(node).wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

impl Recording {
    /// Adds a view, within the bounds. `nodes_so_far` is the caller's count of recorded nodes.
    pub(crate) fn push_view(&mut self, mut view: ViewRecord, nodes_so_far: &mut usize) {
        if self.views.len() >= VIEWS_MAX {
            self.dropped.views += 1;
            return;
        }
        if *nodes_so_far + view.nodes.len() > VIEW_NODES_MAX {
            view.nodes = Vec::new();
            self.dropped.view_nodes += 1;
        }
        *nodes_so_far += view.nodes.len();
        self.views.push(view);
    }

    /// Adds an operation, within the bounds.
    pub(crate) fn push_operation(&mut self, operation: OperationRecord) {
        if self.operations.len() < OPERATIONS_MAX {
            self.operations.push(operation);
        } else {
            self.dropped.operations += 1;
        }
    }
}

/// The nodes of a view to record: those that moved, limited to the same ones at every site.
fn choose_nodes(moved: impl Iterator<Item = (u32, [f64; 3])>) -> Vec<(u32, f32, f32, f32)> {
    let mut chosen: Vec<(u32, [f64; 3])> = moved
        .map(|(n, u)| (n, u.map(|c| c * 1e3)))
        .filter(|(_, mm)| mm.iter().map(|c| c * c).sum::<f64>() > NODE_MOVED_MM * NODE_MOVED_MM)
        .collect();
    if chosen.len() > NODES_PER_VIEW_MAX {
        chosen.select_nth_unstable_by_key(NODES_PER_VIEW_MAX, |(n, _)| node_rank(*n));
        chosen.truncate(NODES_PER_VIEW_MAX);
    }
    chosen.sort_unstable_by_key(|(n, _)| *n);
    let as_row = |(n, [x, y, z]): (u32, [f64; 3])| (n, x as f32, y as f32, z as f32);
    chosen.into_iter().map(as_row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_site_keeps_the_same_nodes() {
        let all = || (0..5000u32).map(|n| (n, [1e-3, 0.0, 0.0]));
        let a = choose_nodes(all());
        let b = choose_nodes(all().collect::<Vec<_>>().into_iter().rev());
        assert_eq!(a.len(), NODES_PER_VIEW_MAX);
        assert_eq!(a, b);
        // A few more nodes elsewhere change a few of the selected ones.
        let more = choose_nodes(all().chain((9000..9050).map(|n| (n, [1e-3, 0.0, 0.0]))));
        let kept = more.iter().filter(|r| a.contains(r)).count();
        assert!(kept > NODES_PER_VIEW_MAX * 9 / 10, "{kept}");
    }

    #[test]
    fn small_displacements_are_omitted_and_unit_is_mm() {
        let moved = [(7, [0.0, 0.0, -2e-3]), (8, [0.0, 4e-5, 0.0])];
        assert_eq!(choose_nodes(moved.into_iter()), [(7, 0.0, 0.0, -2.0)]);
    }

    #[test]
    fn dropped_items_are_counted() {
        let mut recording = Recording::default();
        let view = || ViewRecord {
            nodes: vec![(1, 0.0, 0.0, 0.0); 10],
            ..ViewRecord::default()
        };
        let mut nodes = VIEW_NODES_MAX - 15;
        recording.push_view(view(), &mut nodes);
        recording.push_view(view(), &mut nodes);
        assert_eq!(recording.views[1].nodes.len(), 0);
        assert_eq!(recording.dropped.view_nodes, 1);
    }

    #[test]
    fn recording_round_trips_through_json() {
        let mut recording = Recording::default();
        let view = ViewRecord {
            nodes: vec![(3, 0.5, -1.0, 2.0)],
            ..ViewRecord::default()
        };
        recording.push_view(view, &mut 0);
        let text = serde_json::to_string(&recording).unwrap();
        assert!(text.contains("[3,0.5,-1.0,2.0]"), "{text}");
        assert_eq!(serde_json::from_str::<Recording>(&text).unwrap(), recording);
    }
}
