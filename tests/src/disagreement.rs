//! Disagreement between the views of two participants.
//!
//! A view has the session time s and the display time on the monotonic clock, which all processes of one
//! machine share. It also has each tool position, and the displacement of each node that moved by more than
//! 0.05 mm.
//!
//! - The DISAGREEMENT OF VIEWS compares two participants at the same instant of real time. On a grid of 10 ms
//!   each recording is interpolated linearly between two views. It covers every tool that both show and every
//!   recorded node (a node that one side did not record is undisplaced there). An item counts at an instant if,
//!   on either side, the tool moves or the node is displaced by more than 0.05 mm. Resting items are excluded,
//!   because they would only lower the percentiles.
//! - The DISAGREEMENT OF CONTENTS compares two participants at the same session time s, whenever they display
//!   it. It measures lost packets and solvers that stopped early; the rest of the disagreement of views is
//!   delay.

use std::collections::BTreeMap;

use palpate_client::recording::{NODES_PER_VIEW_MAX, Recording, ViewRecord, node_rank};
use serde::{Deserialize, Serialize};

use crate::bench::quantile_of_sorted;

const GRID_US: i64 = 10_000;

/// Displacements and motions below this do not count, mm. Recordings leave such nodes out.
const MOVED_MM: f64 = 0.05;

/// Maximum pause between two views for interpolation, µs.
const PAUSE_MAX_US: i64 = 250_000;

const INTERVAL_US: i64 = 100_000;

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct DistancesMm {
    pub p50: f64,
    pub p95: f64,
    pub max: f64,
    pub count: usize,
}

impl DistancesMm {
    /// Percentiles of all distances; zeros when there are none.
    pub fn of(distances: &mut [f32]) -> Self {
        if distances.is_empty() {
            return Self::default();
        }
        distances.sort_unstable_by(f32::total_cmp);
        let at = |q: f64| quantile_of_sorted(distances, q).map_or(0.0, f64::from);
        Self {
            p50: at(0.5),
            p95: at(0.95),
            max: at(1.0),
            count: distances.len(),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DisagreementPoint {
    /// Middle of the interval, monotonic, µs.
    pub t_us: i64,
    pub p95_mm: f64,
    pub max_mm: f64,
}

#[derive(Debug, Clone, Default, PartialEq)]
pub struct Disagreement {
    pub views: DistancesMm,
    pub tools: DistancesMm,
    pub nodes: DistancesMm,
    /// Contents at equal s.
    pub contents: DistancesMm,
    pub over_time: Vec<DisagreementPoint>,
}

/// A view interpolated at one instant: positions in mm.
#[derive(Debug, Default)]
struct Seen {
    /// Position of each tool, and its motion between the views around the instant.
    tools: BTreeMap<u16, ([f64; 3], f64)>,
    nodes: BTreeMap<u32, [f64; 3]>,
    /// Highest recorded rank; nodes of a higher rank did not fit into the recording.
    rank_max: u64,
}

#[derive(Debug, Clone, Copy)]
enum Distance {
    Tool(f32),
    Node(f32),
}

impl Distance {
    fn mm(self) -> f32 {
        match self {
            Self::Tool(mm) | Self::Node(mm) => mm,
        }
    }
}

impl Disagreement {
    pub fn between(recordings: &[&Recording]) -> Self {
        let mut views: Vec<(i64, Distance)> = Vec::new();
        let mut contents: Vec<f32> = Vec::new();
        for (i, a) in recordings.iter().enumerate() {
            for b in &recordings[i + 1..] {
                compare_views(a, b, &mut views);
                compare_contents(a, b, &mut contents);
            }
        }
        let pick = |wanted: fn(&Distance) -> bool| -> Vec<f32> {
            let distances = views.iter().map(|v| v.1).filter(wanted);
            distances.map(Distance::mm).collect()
        };
        Self {
            views: DistancesMm::of(&mut pick(|_| true)),
            tools: DistancesMm::of(&mut pick(|d| matches!(d, Distance::Tool(_)))),
            nodes: DistancesMm::of(&mut pick(|d| matches!(d, Distance::Node(_)))),
            contents: DistancesMm::of(&mut contents),
            over_time: over_time(&views),
        }
    }
}

/// Passes every instant, µs, with the distance in mm of every counted node to `visit`.
pub fn each_node(a: &Recording, b: &Recording, mut visit: impl FnMut(i64, f32)) {
    let mut views = Vec::new();
    compare_views(a, b, &mut views);
    for (t, distance) in views {
        if let Distance::Node(mm) = distance {
            visit(t, mm);
        }
    }
}

fn over_time(views: &[(i64, Distance)]) -> Vec<DisagreementPoint> {
    let mut pieces: BTreeMap<i64, Vec<f32>> = BTreeMap::new();
    for (t, d) in views {
        let piece = t.div_euclid(INTERVAL_US);
        pieces.entry(piece).or_default().push(d.mm());
    }
    pieces
        .into_iter()
        .map(|(piece, mut distances)| {
            let figures = DistancesMm::of(&mut distances);
            DisagreementPoint {
                t_us: piece * INTERVAL_US + INTERVAL_US / 2,
                p95_mm: figures.p95,
                max_mm: figures.max,
            }
        })
        .collect()
}

fn compare_views(a: &Recording, b: &Recording, out: &mut Vec<(i64, Distance)>) {
    let ends = |r: &Recording| Some([r.views.first()?.shown_us, r.views.last()?.shown_us]);
    let (Some(ends_a), Some(ends_b)) = (ends(a), ends(b)) else {
        return;
    };
    let (from, until) = (ends_a[0].max(ends_b[0]), ends_a[1].min(ends_b[1]));
    let (mut ia, mut ib) = (0, 0);
    let mut t = from.div_euclid(GRID_US) * GRID_US + GRID_US;
    while t < until {
        if let (Some(x), Some(y)) = (seen_at(&a.views, &mut ia, t), seen_at(&b.views, &mut ib, t)) {
            distances(&x, &y, |d| out.push((t, d)));
        }
        t += GRID_US;
    }
}

/// The view at `t`; `index` is the result of the last search.
fn seen_at(views: &[ViewRecord], index: &mut usize, t: i64) -> Option<Seen> {
    while views.get(*index + 1).is_some_and(|v| v.shown_us <= t) {
        *index += 1;
    }
    let (before, after) = (views.get(*index)?, views.get(*index + 1)?);
    let pause = after.shown_us - before.shown_us;
    if t < before.shown_us || pause > PAUSE_MAX_US || pause <= 0 {
        return None;
    }
    let share = (t - before.shown_us) as f64 / pause as f64;
    Some(blend(before, after, share))
}

fn blend(before: &ViewRecord, after: &ViewRecord, share: f64) -> Seen {
    let mix = |p: [f64; 3], q: [f64; 3]| -> [f64; 3] {
        std::array::from_fn(|i| p[i] + share * (q[i] - p[i]))
    };
    let mut seen = Seen {
        rank_max: rank_max(before).min(rank_max(after)),
        ..Seen::default()
    };
    for tool in &before.tools {
        let Some(next) = after
            .tools
            .iter()
            .find(|t| t.participant == tool.participant)
        else {
            continue;
        };
        let (p, q) = (tool.position_m.map(mm), next.position_m.map(mm));
        seen.tools
            .insert(tool.participant, (mix(p, q), distance(p, q)));
    }
    for (n, x, y, z) in &before.nodes {
        let p = [*x, *y, *z].map(f64::from);
        seen.nodes.insert(*n, mix(p, [0.0; 3]));
    }
    for (n, x, y, z) in &after.nodes {
        let q = [*x, *y, *z].map(f64::from);
        let u = seen.nodes.entry(*n).or_insert([0.0; 3]);
        *u = std::array::from_fn(|i| u[i] + share * q[i]);
    }
    seen
}

fn mm(metres: f64) -> f64 {
    metres * 1e3
}

fn rank_max(view: &ViewRecord) -> u64 {
    if view.nodes.len() < NODES_PER_VIEW_MAX {
        return u64::MAX;
    }
    view.nodes
        .iter()
        .map(|n| node_rank(n.0))
        .max()
        .unwrap_or(u64::MAX)
}

fn distance(p: [f64; 3], q: [f64; 3]) -> f64 {
    (0..3).map(|i| (p[i] - q[i]).powi(2)).sum::<f64>().sqrt()
}

fn distances(a: &Seen, b: &Seen, mut out: impl FnMut(Distance)) {
    for (participant, (p, moves)) in &a.tools {
        if let Some((q, also)) = b.tools.get(participant)
            && moves.max(*also) > MOVED_MM
        {
            out(Distance::Tool(distance(*p, *q) as f32));
        }
    }
    let rank_max = a.rank_max.min(b.rank_max);
    let rest = [0.0; 3];
    let mut compare = |n: u32, p: [f64; 3], q: [f64; 3]| {
        let displaced = distance(p, rest).max(distance(q, rest));
        if displaced > MOVED_MM && node_rank(n) <= rank_max {
            out(Distance::Node(distance(p, q) as f32));
        }
    };
    for (n, p) in &a.nodes {
        compare(*n, *p, b.nodes.get(n).copied().unwrap_or(rest));
    }
    for (n, q) in &b.nodes {
        if !a.nodes.contains_key(n) {
            compare(*n, rest, *q);
        }
    }
}

fn compare_contents(a: &Recording, b: &Recording, out: &mut Vec<f32>) {
    let of_b: BTreeMap<i64, usize> = (b.views.iter().enumerate())
        .map(|(i, v)| (v.s_us, i))
        .collect();
    for (i, view) in a.views.iter().enumerate().skip(1) {
        let Some(&j) = of_b.get(&view.s_us) else {
            continue;
        };
        if j == 0 || a.views[i - 1].s_us != b.views[j - 1].s_us {
            continue;
        }
        // The previous view shows which tools move.
        let x = blend(&a.views[i - 1], view, 1.0);
        let y = blend(&b.views[j - 1], &b.views[j], 1.0);
        distances(&x, &y, |d| out.push(d.mm()));
    }
}

#[cfg(test)]
mod tests {
    use palpate_client::recording::{Recording, ToolRecord, ViewRecord};

    use super::Disagreement;

    /// A tool that moves along x at `speed` m/s, displayed `late_us` late, and a node that follows it in mm.
    fn recording(late_us: i64, speed: f64) -> Recording {
        let view = |i: i64| {
            let s_us = i * 20_000;
            let x = speed * s_us as f64 * 1e-6;
            ViewRecord {
                s_us,
                shown_us: s_us + late_us,
                delay_us: 0,
                tools: vec![ToolRecord {
                    participant: 1,
                    position_m: [x, 0.0, 0.0],
                    stale: false,
                    inserted: false,
                }],
                nodes: vec![(7, (x * 1e3) as f32, 0.0, 0.0)],
                topology_version: 0,
            }
        };
        Recording {
            views: (0..100).map(view).collect(),
            ..Recording::default()
        }
    }

    #[test]
    fn equal_views_have_no_disagreement() {
        let a = recording(0, 0.1);
        let d = Disagreement::between(&[&a, &a.clone(), &a.clone()]);
        assert_eq!(d.views.max, 0.0);
        assert!(d.tools.count > 500 && d.nodes.count > 500);
    }

    #[test]
    fn late_view_disagrees_by_its_motion_and_agrees_on_contents() {
        let (a, b) = (recording(0, 0.1), recording(30_000, 0.1));
        let d = Disagreement::between(&[&a, &b]);
        assert!((d.tools.p50 - 3.0).abs() < 1e-3, "{:?}", d.tools);
        assert!((d.nodes.p50 - 3.0).abs() < 1e-3, "{:?}", d.nodes);
        assert!(d.contents.count > 100 && d.contents.max < 1e-6);
        assert!(d.over_time.len() > 10 && (d.over_time[5].p95_mm - 3.0).abs() < 1e-3);
    }

    #[test]
    fn resting_items_do_not_count() {
        let a = recording(0, 0.0);
        assert_eq!(Disagreement::between(&[&a, &a.clone()]).views.count, 0);
    }

    #[test]
    fn unrecorded_node_is_undisplaced() {
        let a = recording(0, 0.1);
        let mut b = a.clone();
        for view in &mut b.views {
            view.nodes.clear();
        }
        let d = Disagreement::between(&[&a, &b]);
        let last = 0.1 * 1.98 * 1e3;
        assert!(d.nodes.max > 0.95 * last && d.nodes.max <= last);
        assert_eq!(d.tools.max, 0.0);
    }

    #[test]
    fn single_recording_has_no_disagreement() {
        let empty = Recording::default();
        let a = recording(0, 0.1);
        assert_eq!(
            Disagreement::between(&[&a, &empty]),
            Disagreement::default()
        );
    }
}
