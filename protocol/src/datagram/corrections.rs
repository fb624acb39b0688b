//! Displacements of nodes in a datagram.
//!
//! ```text
//! topology version u32 | age i32 µs before `generated` | count u16, then per node, ascending
//!   difference to the node before, minus one, as a packed number | displacement 3 x i16 of 0.01 mm
//! ```

use super::bytes::{Reader, Writer};
use super::{DATAGRAM_MAX_BYTES, HEADER_BYTES, quantise};
use crate::{ProtocolError, ServerTime, Span};

/// Step of a displacement in metres: 0.01 mm, for a range of ±327 mm. A larger displacement is
/// sent as the largest.
pub const DISPLACEMENT_STEP_M: f64 = 1e-5;

const FIXED_BYTES: usize = 10;
const NODE_MIN_BYTES: usize = 7;

/// The most nodes in one datagram: a byte of difference and six of displacement each.
pub const NODES_MAX: usize = (DATAGRAM_MAX_BYTES - HEADER_BYTES - FIXED_BYTES) / NODE_MIN_BYTES;

/// Where some nodes of the tissue are.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Corrections {
    /// The topology that the node numbers belong to; of another one they mean nothing.
    pub topology_version: u32,
    /// The moment that the displacements are for.
    pub view_time: ServerTime,
    /// Node and displacement from its rest position in metres; nodes ascend.
    pub nodes: Vec<(u32, [f32; 3])>,
}

impl Corrections {
    /// Divides a list of any length into pieces that each fit into a datagram. Nodes must ascend.
    pub fn pieces(
        topology_version: u32,
        view_time: ServerTime,
        nodes: &[(u32, [f32; 3])],
    ) -> Vec<Self> {
        let mut pieces = Vec::new();
        let mut rest = nodes;
        while !rest.is_empty() {
            let (piece, after) = rest.split_at(fitting(rest));
            pieces.push(Self {
                topology_version,
                view_time,
                nodes: piece.to_vec(),
            });
            rest = after;
        }
        pieces
    }
}

/// How many of the first nodes fit into one datagram, at least one.
fn fitting(nodes: &[(u32, [f32; 3])]) -> usize {
    let mut bytes = HEADER_BYTES + FIXED_BYTES;
    let mut next = 0;
    for (i, (node, _)) in nodes.iter().enumerate() {
        let step = node.saturating_sub(next);
        bytes += 6 + (32 - (step | 1).leading_zeros()).div_ceil(7) as usize;
        if bytes > DATAGRAM_MAX_BYTES {
            return i.max(1);
        }
        next = node.saturating_add(1);
    }
    nodes.len()
}

pub(super) fn write(
    w: &mut Writer,
    generated: ServerTime,
    c: &Corrections,
) -> Result<(), ProtocolError> {
    let refuse = |what, detail| Err(ProtocolError::OutOfRange { what, detail });
    if c.nodes.len() > NODES_MAX {
        return refuse("the number of nodes", c.nodes.len().to_string());
    }
    w.u32(c.topology_version);
    let age = (generated - c.view_time).as_micros();
    let Ok(age) = i32::try_from(age) else {
        return refuse("the age of a correction", format!("{age} µs"));
    };
    w.i32(age);
    w.u16(c.nodes.len() as u16);
    let mut next = 0_u32;
    for (node, displacement) in &c.nodes {
        let Some(step) = node.checked_sub(next).filter(|_| *node < u32::MAX) else {
            return refuse(
                "a node",
                format!("{node} where nodes must ascend from {next}"),
            );
        };
        w.varint(step);
        next = node + 1;
        for x in displacement {
            w.i16(quantise::saturating_i16(f64::from(*x), DISPLACEMENT_STEP_M));
        }
    }
    Ok(())
}

pub(super) fn read(
    r: &mut Reader<'_>,
    generated: ServerTime,
) -> Result<Corrections, ProtocolError> {
    r.part("corrections");
    let topology_version = r.u32()?;
    let view_time = generated - Span::from_micros(i64::from(r.i32()?));
    let count = usize::from(r.u16()?);
    r.expect_items(count, NODE_MIN_BYTES)?;
    let mut next = 0_u32;
    let mut nodes = Vec::with_capacity(count);
    for _ in 0..count {
        let node = next
            .checked_add(r.varint()?)
            .filter(|n| *n < u32::MAX)
            .ok_or_else(|| ProtocolError::OutOfRange {
                what: "a node",
                detail: "beyond 32 bits".to_owned(),
            })?;
        next = node + 1;
        let mut displacement = [0.0; 3];
        for x in &mut displacement {
            *x = (f64::from(r.i16()?) * DISPLACEMENT_STEP_M) as f32;
        }
        nodes.push((node, displacement));
    }
    Ok(Corrections {
        topology_version,
        view_time,
        nodes,
    })
}
