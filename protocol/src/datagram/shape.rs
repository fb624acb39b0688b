//! Displacements of nodes in a datagram.
//!
//! Range-coded (`range_coder.rs`):
//!
//! ```text
//! topology version (32 raw bits) | age µs before `generated` (32 raw bits, signed)
//! step µm (10 raw bits) | count (11 raw bits) | whether from a baseline; if so: datagrams ago
//! nodes that wait
//! per node, ascending: difference to the node before, minus one; displacement in steps
//! ```
//!
//! A node in the baseline is predicted at its baseline displacement plus the motion of the node before;
//! any other node at the displacement of the node before. The expected magnitude of a difference adapts
//! within the datagram.

use super::memory::Memory;
use super::range_coder::{Chance, Coder, Number};
use super::{Moment, quantise};
use crate::{ProtocolError, ServerTime, Span};

/// Step of a displacement for comparison in micrometres, for a range of ±327 mm.
pub(super) const FINE_STEP_UM: u16 = 10;

/// The largest step of displacements, micrometres; a coarser one can be felt.
pub const STEP_MAX_UM: u16 = 1000;

/// The most nodes in one datagram; more would fit only without motion.
pub const NODES_MAX: usize = 1024;

/// Nodes in a piece: usually short enough for a datagram. An unchanged list is divided at the same
/// places, so that each piece finds its baseline.
pub const PIECE_NODES: usize = 256;

/// Classes of the magnitude of the previous difference.
const CLASSES: usize = 6;

/// Displacements in integers.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct Nodes {
    pub(super) step_um: u16,
    pub(super) list: Vec<(u32, [i16; 3])>,
}

impl Nodes {
    /// The first node, zero where there is none.
    pub(super) fn first(&self) -> u32 {
        self.list.first().map_or(0, |n| n.0)
    }

    /// Rounds displacements in metres, clamped to the range.
    pub(super) fn of(step_um: u16, nodes: &[(u32, [f32; 3])]) -> Self {
        let step = f64::from(step_um) * 1e-6;
        let round = |d: &[f32; 3]| d.map(|x| quantise::saturating_i16(f64::from(x), step));
        Self {
            step_um,
            list: nodes.iter().map(|(n, d)| (*n, round(d))).collect(),
        }
    }

    /// The displacements in metres.
    pub(super) fn metres(&self) -> Vec<(u32, [f32; 3])> {
        let step = f64::from(self.step_um) * 1e-6;
        let back = |d: &[i16; 3]| d.map(|x| (f64::from(x) * step) as f32);
        self.list.iter().map(|(n, d)| (*n, back(d))).collect()
    }
}

/// The topology version and the time of the displacements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Frame {
    pub(super) topology_version: u32,
    pub(super) view_time: ServerTime,
    /// Nodes in view with an error that did not fit into the rate; 0 for corrections.
    pub(super) waiting: u32,
}

/// The largest number of waiting nodes that is sent; larger numbers are clamped.
const WAITING_MAX: u32 = (1 << 25) - 1;

/// The probabilities for all symbols in a body.
struct Model {
    ago: Number,
    waiting: Number,
    gap: Number,
    has_baseline: Chance,
    /// By whether the baseline has the node, by axis and by class.
    parts: [[[Number; CLASSES]; 3]; 2],
}

impl Model {
    fn new() -> Self {
        let ago = Number::new(&[254, 240, 220, 200, 160, 100, 60, 30]);
        let rising = |class: usize| {
            let more: [u8; 12] = std::array::from_fn(|i| match (i, class) {
                (0, 0) => 60,
                (i, c) if i < c => 225,
                (i, c) if i == c => 130,
                _ => 60,
            });
            Number::new(&more)
        };
        let axis = || std::array::from_fn(rising);
        let axes = || std::array::from_fn(|_| axis());
        Self {
            ago,
            waiting: Number::new(&[20, 230]),
            gap: Number::new(&[90, 120, 128]),
            has_baseline: Chance::EVEN,
            parts: std::array::from_fn(|_| axes()),
        }
    }
}

fn refuse(what: &'static str, detail: String) -> ProtocolError {
    ProtocolError::OutOfRange { what, detail }
}

/// Follows a baseline along ascending nodes.
struct Along<'a> {
    rest: &'a [(u32, [i16; 3])],
}

impl Along<'_> {
    fn at(&mut self, node: u32) -> Option<[i32; 3]> {
        let skip = self.rest.iter().take_while(|(n, _)| *n < node).count();
        self.rest = &self.rest[skip..];
        let found = self.rest.first().filter(|(n, _)| *n == node);
        found.map(|(_, d)| d.map(i32::from))
    }
}

/// Codes the nodes; a decoder returns as many as it reads.
fn code_list(
    c: &mut impl Coder,
    m: &mut Model,
    baseline: &[(u32, [i16; 3])],
    list: &mut [(u32, [i16; 3])],
) -> Result<(), ProtocolError> {
    let mut along = Along { rest: baseline };
    let (mut next, mut previous, mut moved) = (0_u32, [0_i32; 3], [0_i32; 3]);
    let mut classes = [0_usize; 3];
    for (node, displacement) in list {
        let gap = m.gap.code(c, node.wrapping_sub(next) as i32)?;
        let here = u32::try_from(gap)
            .ok()
            .and_then(|gap| next.checked_add(gap));
        *node = here.filter(|n| *n < u32::MAX).ok_or_else(|| {
            refuse(
                "a node",
                format!("{gap} after {next}, where nodes must ascend"),
            )
        })?;
        next = *node + 1;
        let before = along.at(*node);
        let parts = &mut m.parts[usize::from(before.is_some())];
        for (i, d) in displacement.iter_mut().enumerate() {
            let near = before.map_or(previous[i], |b| b[i] + moved[i]);
            let difference = parts[i][classes[i]].code(c, i32::from(*d) - near)?;
            let value = near + difference;
            *d = i16::try_from(value)
                .map_err(|_| refuse("a displacement", format!("{value} steps")))?;
            let bits = (32 - difference.unsigned_abs().leading_zeros()) as usize;
            classes[i] = bits.min(CLASSES - 1);
            previous[i] = value;
            // Half of it: neighbours in the list are not always neighbours in the tissue.
            moved[i] = before.map_or(0, |b| (value - b[i]) / 2);
        }
    }
    Ok(())
}

/// Writes the body, and remembers its content.
pub(super) fn write(
    c: &mut impl Coder,
    at: Moment,
    memory: &mut Memory,
    frame: Frame,
    mut nodes: Nodes,
) -> Result<(), ProtocolError> {
    if nodes.list.len() > NODES_MAX {
        return Err(ProtocolError::TooLarge {
            what: "list of displacements",
            bytes: nodes.list.len(),
            limit: NODES_MAX,
        });
    }
    if !(1..=STEP_MAX_UM).contains(&nodes.step_um) {
        return Err(refuse(
            "the step of displacements",
            format!("{} µm", nodes.step_um),
        ));
    }
    let rises = nodes.list.is_sorted_by(|a, b| a.0 < b.0);
    let widest = nodes.list.last().filter(|n| n.0 >= 1 << 25);
    if !rises || widest.is_some() {
        let detail = "nodes must ascend and be below 2^25".to_owned();
        return Err(refuse("a node", detail));
    }
    let generated = quantise::time_back(quantise::time(at.generated));
    let age = (generated - frame.view_time).as_micros();
    let Ok(age) = i32::try_from(age) else {
        return refuse_age(age);
    };
    c.raw(32, frame.topology_version)?;
    c.raw(32, age as u32)?;
    c.raw(10, u32::from(nodes.step_um))?;
    c.raw(11, nodes.list.len() as u32)?;
    let mut m = Model::new();
    let known = memory.known_shape(nodes.step_um, nodes.first());
    c.bit(&mut m.has_baseline, known.is_some())?;
    if let Some((sequence, _)) = known {
        m.ago.code(c, at.sequence.wrapping_sub(sequence) as i32)?;
    }
    let waiting = frame.waiting.min(WAITING_MAX) as i32;
    m.waiting.code(c, waiting)?;
    let baseline = known.map_or(&[][..], |(_, n)| &n.list);
    code_list(c, &mut m, baseline, &mut nodes.list)?;
    memory.remember_shape(at.sequence, nodes);
    Ok(())
}

fn refuse_age(age: i64) -> Result<(), ProtocolError> {
    Err(refuse("the age of displacements", format!("{age} µs")))
}

/// Reads the body, and remembers its content.
pub(super) fn read(
    c: &mut impl Coder,
    at: Moment,
    memory: &mut Memory,
) -> Result<(Frame, Nodes), ProtocolError> {
    let topology_version = c.raw(32, 0)?;
    let age = c.raw(32, 0)? as i32;
    let step_um = c.raw(10, 0)? as u16;
    let count = c.raw(11, 0)? as usize;
    if !(1..=STEP_MAX_UM).contains(&step_um) {
        return Err(refuse("the step of displacements", format!("{step_um} µm")));
    }
    if count > NODES_MAX {
        return Err(refuse("the number of nodes", count.to_string()));
    }
    let mut m = Model::new();
    let empty = Nodes::default();
    let baseline = if c.bit(&mut m.has_baseline, false)? {
        let sequence = at.sequence.wrapping_sub(m.ago.code(c, 0)? as u32);
        let known = memory.shape_at(sequence);
        let known = known.filter(|n| n.step_um == step_um);
        known.ok_or(ProtocolError::NoBaseline { sequence })?
    } else {
        &empty
    };
    let waiting = m.waiting.code(c, 0)?;
    let waiting = u32::try_from(waiting)
        .map_err(|_| refuse("the number of nodes that wait", waiting.to_string()))?;
    let mut list = vec![(0, [0; 3]); count];
    code_list(c, &mut m, &baseline.list, &mut list)?;
    let nodes = Nodes { step_um, list };
    memory.remember_shape(at.sequence, nodes.clone());
    let frame = Frame {
        topology_version,
        view_time: at.generated - Span::from_micros(i64::from(age)),
        waiting,
    };
    Ok((frame, nodes))
}
