//! The strokes of a history as content of a snapshot: lists of stroke parts, the first with all parts in effect, then one
//! for every stroke taken back.
//!
//! ```text
//! counts     lists (u32), parts of each list (steps)
//! parts      points (steps), flags (bit 0: joins, bit 1: has a stroke), stroke, f64 bits of the width of each part
//! points     seven columns of f64 bits of all points (tip, axis, depth), each XOR the one before
//! ```

use std::sync::Arc;

use crate::file::{Content, Reader};
use crate::limits::BLADE_POINTS_MAX;
use crate::{BladePoint, CutHistory, CutStroke, StrokePart, Vec3};

const JOINS: u8 = 1;
const HAS_STROKE: u8 = 2;

/// Parts of strokes, in order.
type Parts = Vec<Arc<StrokePart>>;

pub(crate) fn write_strokes(out: &mut Content, history: &CutHistory) {
    let lists: Vec<&[Arc<StrokePart>]> = std::iter::once(history.done())
        .chain(history.undone().iter().map(Vec::as_slice))
        .collect();
    let parts: Vec<&StrokePart> = lists.iter().copied().flatten().map(Arc::as_ref).collect();
    out.u32(lists.len() as u32);
    out.steps32(lists.iter().map(|list| list.len() as u32));
    out.steps32(parts.iter().map(|part| part.path.points.len() as u32));
    for part in &parts {
        let has_stroke = u8::from(part.stroke.is_some());
        out.u8((u8::from(part.joins) * JOINS) | (has_stroke * HAS_STROKE));
    }
    out.plane64(&parts.iter().map(|part| part.stroke.unwrap_or(0)));
    out.plane64(&parts.iter().map(|part| part.path.width_m.to_bits()));
    let points: Vec<[u64; 7]> = parts
        .iter()
        .flat_map(|part| &part.path.points)
        .map(columns)
        .collect();
    for column in 0..7 {
        let before = std::iter::once(0).chain(points.iter().map(|p| p[column]));
        let here = points.iter().map(|p| p[column]);
        out.plane64(&here.zip(before).map(|(here, before)| here ^ before));
    }
}

/// The parts in effect, and every stroke taken back.
pub(crate) fn read_strokes(reader: &mut Reader<'_>) -> Result<(Parts, Vec<Parts>), String> {
    let lists = reader.u32()? as usize;
    let lengths = reader.steps32(lists)?;
    let total = |counts: &[u32]| counts.iter().map(|&n| n as usize).sum::<usize>();
    let parts = total(&lengths);
    let points = reader.steps32(parts)?;
    if points
        .iter()
        .any(|&n| !(1..=BLADE_POINTS_MAX).contains(&(n as usize)))
    {
        return Err("has a part of a stroke with too few or too many points".into());
    }
    let flags = reader.bytes(parts)?;
    let strokes = reader.plane64(parts)?;
    let widths = reader.plane64(parts)?;
    let mut rows = vec![[0; 7]; 0];
    for column in 0..7 {
        let values = reader.plane64(total(&points))?;
        rows.resize(values.len(), [0; 7]);
        let mut before = 0;
        for (row, value) in rows.iter_mut().zip(values) {
            before ^= value;
            row[column] = before;
        }
    }
    let is_finite = |row: &[u64; 7]| row.iter().all(|&bits| f64::from_bits(bits).is_finite());
    if !rows.iter().all(is_finite) {
        return Err("has a point of a stroke that is not finite".into());
    }
    let mut rows = rows.iter().map(point);
    let mut parts = (0..parts).map(|i| {
        Arc::new(StrokePart {
            path: CutStroke {
                points: rows.by_ref().take(points[i] as usize).collect(),
                width_m: f64::from_bits(widths[i]),
            },
            stroke: (flags[i] & HAS_STROKE != 0).then_some(strokes[i]),
            joins: flags[i] & JOINS != 0,
        })
    });
    let mut lists = lengths
        .iter()
        .map(|&length| parts.by_ref().take(length as usize).collect());
    let done = lists.next().ok_or("has no list of strokes in effect")?;
    Ok((done, lists.collect()))
}

fn columns(point: &BladePoint) -> [u64; 7] {
    let [a, b] = [point.tip, point.axis];
    [a.x, a.y, a.z, b.x, b.y, b.z, point.depth_m].map(f64::to_bits)
}

fn point(bits: &[u64; 7]) -> BladePoint {
    let [a, b, c, d, e, f, depth_m] = bits.map(f64::from_bits);
    BladePoint {
        tip: Vec3::new(a, b, c),
        axis: Vec3::new(d, e, f),
        depth_m,
    }
}
