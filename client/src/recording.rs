//! What a run looked like, written as JSON for comparisons between sites.
//!
//! Everything is bounded; what found no room is counted in [`Dropped`].

use nalgebra::Vector3;
use palpate_device::{Buttons, Pose};
use palpate_protocol::operation::CutStroke;
use serde::{Deserialize, Serialize};

/// Points of the hand's path: 20 minutes of every fourth tick. Later ones are dropped and counted.
pub const HAPTIC_POINTS_MAX: usize = 300_000;

/// Views: 20 minutes at [`VIEW_HZ`]. Later ones are dropped and counted.
pub const VIEWS_MAX: usize = 60_000;

/// Nodes of all views together, 16 B each. Later views come without nodes, and are counted.
pub const VIEW_NODES_MAX: usize = 4_000_000;

/// Views recorded per second, at most: every n-th of the common grid, the same ones at every site.
pub const VIEW_HZ: u32 = 50;

/// Nodes of one view. When more moved, those with the smallest [`node_rank`] are kept, so that all
/// sites keep the same ones.
pub const NODES_PER_VIEW_MAX: usize = 512;

/// A node is recorded when its displacement is larger than this, mm.
pub const NODE_MOVED_MM: f64 = 0.05;

/// Operations: the log of a long session. Later ones are dropped and counted.
pub const OPERATIONS_MAX: usize = 100_000;

/// One run of one participant. Times in µs; `t_us`, `shown_us` and `applied_us` on the machine's
/// monotonic clock, `s_us` and `at_us` on the server's.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Recording {
    /// The participant's name.
    pub name: String,
    /// The participant's number.
    pub participant: u16,
    /// The word for the role.
    pub role: String,
    /// When the script began, on the monotonic clock; `None` when it did not.
    pub script_started_us: Option<i64>,
    /// The hand: every fourth tick of the force loop.
    pub haptic: Vec<HapticPoint>,
    /// What was shown.
    pub views: Vec<ViewRecord>,
    /// What was applied, in order.
    pub operations: Vec<OperationRecord>,
    /// What found no room.
    pub dropped: Dropped,
}

/// The hand at one moment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HapticPoint {
    /// When, monotonic.
    pub t_us: i64,
    /// Where the tool was, m.
    pub position_m: [f64; 3],
    /// How it was turned: x, y, z, w of a unit quaternion.
    pub orientation: [f64; 4],
    /// The buttons that were held, one bit each; bit 0 cuts.
    pub buttons: u32,
    /// The force on the tool, N.
    pub force_n: [f64; 3],
}

impl HapticPoint {
    /// A point of a sample of the device, and the force (N) on the tool then.
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

/// One view of the table.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewRecord {
    /// The moment that it shows, server time.
    pub s_us: i64,
    /// When it became visible, monotonic.
    pub shown_us: i64,
    /// The artificial delay D then.
    pub delay_us: i64,
    /// Everybody's tool, one's own included.
    pub tools: Vec<ToolRecord>,
    /// Node number and displacement x, y, z in mm.
    pub nodes: Vec<(u32, f32, f32, f32)>,
    /// Version of the topology.
    pub topology_version: u32,
}

/// A tool in a view.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ToolRecord {
    /// Whose.
    pub participant: u16,
    /// Where, m.
    pub position_m: [f64; 3],
    /// Whether nothing has come from it for too long.
    pub stale: bool,
}

/// An operation that was applied.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OperationRecord {
    /// Its place in the log.
    pub id: u64,
    /// What it did, in one word.
    pub kind: String,
    /// When it happens, server time.
    pub at_us: i64,
    /// When it was applied here, monotonic.
    pub applied_us: i64,
    /// Version of the topology after it.
    pub version: u32,
    /// Hash of the topology after it, 16 hexadecimal digits.
    pub hash: String,
    /// The stroke of a cut, in the rest frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stroke: Option<CutStroke>,
}

/// What found no room.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Dropped {
    /// Points of the hand.
    pub haptic: u64,
    /// Views.
    pub views: u64,
    /// Views that lost their nodes.
    pub view_nodes: u64,
    /// Operations.
    pub operations: u64,
}

/// Sorts nodes in an order that has nothing to do with where they are: the finaliser of `SplitMix64`
/// (Steele, Lea and Flood 2014).
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

/// The nodes of a view to record: those that moved, and of too many the same ones everywhere.
pub fn choose_nodes(moved: impl Iterator<Item = (u32, [f64; 3])>) -> Vec<(u32, f32, f32, f32)> {
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
    fn of_too_many_nodes_every_site_keeps_the_same() {
        let all = || (0..5000u32).map(|n| (n, [1e-3, 0.0, 0.0]));
        let a = choose_nodes(all());
        let b = choose_nodes(all().collect::<Vec<_>>().into_iter().rev());
        assert_eq!(a.len(), NODES_PER_VIEW_MAX);
        assert_eq!(a, b);
        // A few more nodes elsewhere change a few of the chosen ones.
        let more = choose_nodes(all().chain((9000..9050).map(|n| (n, [1e-3, 0.0, 0.0]))));
        let kept = more.iter().filter(|r| a.contains(r)).count();
        assert!(kept > NODES_PER_VIEW_MAX * 9 / 10, "{kept}");
    }

    #[test]
    fn nodes_that_hardly_moved_are_left_out_and_the_rest_is_in_millimetres() {
        let moved = [(7, [0.0, 0.0, -2e-3]), (8, [0.0, 4e-5, 0.0])];
        assert_eq!(choose_nodes(moved.into_iter()), [(7, 0.0, 0.0, -2.0)]);
    }

    #[test]
    fn what_finds_no_room_is_counted() {
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
    fn a_recording_reads_back_as_written() {
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
