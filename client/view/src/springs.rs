//! The springs of one region whose two ends are drawn, as a message for pages.
//!
//! A page has the rest and the displaced positions of the drawn nodes, so the pairs of nodes alone give lengths and
//! strains. They follow every shape without further messages.

use palpate_tissue::cell::NO_CELL;
use palpate_tissue::{RegionId, Topology};

/// Number of this message, see `WIRE.md`.
const KIND: u8 = 4;

/// Flag of a message without all springs.
const IS_CUT_SHORT: u8 = 1;

/// Springs in a message, about 3 MB on a lattice. The thigh sample has 98,547 in its outermost region, 21,434 drawn nodes in
/// all. Further springs are left out, and the message is marked.
pub(crate) const SPRINGS_MAX: usize = 1 << 20;

/// Bytes before the springs.
const HEADER_BYTES: usize = 12;

/// A node that is not drawn.
const HIDDEN: u32 = u32::MAX;

/// The message with the springs of `region`. `drawn` are the nodes of the surface, ascending. Visits all drawn nodes.
pub(crate) fn springs(topology: &Topology, drawn: &[u32], region: u16) -> Vec<u8> {
    encode(topology, drawn, region, SPRINGS_MAX)
}

fn encode(topology: &Topology, drawn: &[u32], region: u16, most: usize) -> Vec<u8> {
    let mut index = vec![HIDDEN; topology.node_count()];
    for (i, node) in (0..).zip(drawn) {
        index[*node as usize] = i;
    }
    let mut bytes = vec![KIND, 0];
    bytes.extend(region.to_le_bytes());
    bytes.extend(topology.version().to_le_bytes());
    bytes.extend([0; 4]);
    debug_assert_eq!(bytes.len(), HEADER_BYTES);
    let (mut count, mut last) = (0_usize, 0_u32);
    let mut ends = Vec::with_capacity(32);
    for (from, node) in (0..).zip(drawn) {
        far_ends(topology, RegionId(region), *node, &index, &mut ends);
        let mut before = from;
        for to in &ends {
            if count == most {
                bytes[1] = IS_CUT_SHORT;
                break;
            }
            write_number(&mut bytes, from - last);
            write_number(&mut bytes, to - before);
            (last, before) = (from, *to);
            count += 1;
        }
    }
    bytes[8..HEADER_BYTES].copy_from_slice(&(count as u32).to_le_bytes());
    bytes
}

/// The drawn nodes with a larger index that springs in cells of `region` connect with `node`, ascending.
fn far_ends(topology: &Topology, region: RegionId, node: u32, index: &[u32], ends: &mut Vec<u32>) {
    ends.clear();
    let own = index[node as usize];
    for cell in topology.cells_around(node) {
        if cell == NO_CELL || topology.region(cell) != region {
            continue;
        }
        // Every two corners of a cell are connected: edges, face diagonals and body diagonals.
        let corners = topology.corners(cell).map(|corner| index[corner as usize]);
        ends.extend(corners.iter().filter(|end| **end != HIDDEN && **end > own));
    }
    ends.sort_unstable();
    ends.dedup();
}

/// Appends an unsigned LEB128 number: seven bits per byte, the lowest first; the highest bit marks all bytes but the
/// last.
fn write_number(bytes: &mut Vec<u8>, mut number: u32) {
    while number >= 0x80 {
        bytes.push(number as u8 | 0x80);
        number >>= 7;
    }
    bytes.push(number as u8);
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use palpate_tissue::{BladePoint, CutStroke, Material, Model, Vec3, block, cut};

    use super::*;
    use crate::surface::Surface;

    /// Two regions, side by side.
    fn two_regions() -> Model {
        let mut model = block([8, 6, 4], 4e-3, &Material::default(), 1);
        let mut second = model.regions[0].clone();
        second.name = "second".into();
        model.regions.push(second);
        for (cell, number) in model.cells.iter_mut().zip(0..) {
            if number % 8 >= 4 {
                cell.region = RegionId(1);
            }
        }
        model
    }

    fn read_number(bytes: &[u8], at: &mut usize) -> u32 {
        let (mut number, mut shift) = (0, 0);
        loop {
            let byte = bytes[*at];
            *at += 1;
            number |= u32::from(byte & 0x7f) << shift;
            shift += 7;
            if byte < 0x80 {
                return number;
            }
        }
    }

    /// The springs of a message, as pairs of nodes of the model.
    fn decode(bytes: &[u8], drawn: &[u32]) -> Vec<[u32; 2]> {
        let count = u32::from_le_bytes(bytes[8..12].try_into().unwrap());
        let (mut at, mut from, mut before) = (HEADER_BYTES, 0, 0);
        let mut pairs = Vec::new();
        for _ in 0..count {
            let ahead = read_number(bytes, &mut at);
            if ahead > 0 || pairs.is_empty() {
                from += ahead;
                before = from;
            }
            before += read_number(bytes, &mut at);
            pairs.push([from, before].map(|i| drawn[i as usize]));
        }
        assert_eq!(at, bytes.len());
        pairs
    }

    #[test]
    fn drawn_springs_are_those_of_the_tissue_before_and_after_a_cut() {
        let mut topology = Topology::new(two_regions().into());
        for version in 0..2 {
            let drawn = Surface::of(&topology).nodes;
            let is_drawn = |node: &u32| drawn.binary_search(node).is_ok();
            let mut expected = BTreeSet::new();
            for node in &drawn {
                for spring in topology.springs_of(*node) {
                    if is_drawn(&spring.to) {
                        expected.insert([*node.min(&spring.to), *node.max(&spring.to)]);
                    }
                }
            }
            let of_region = |region| {
                let bytes = springs(&topology, &drawn, region);
                assert_eq!(bytes[..4], [4, 0, region as u8, 0]);
                assert_eq!(bytes[4], version);
                let pairs = decode(&bytes, &drawn);
                let set: BTreeSet<_> = pairs.iter().copied().collect();
                assert_eq!(set.len(), pairs.len(), "no spring twice");
                set
            };
            let (first, second) = (of_region(0), of_region(1));
            let all: BTreeSet<_> = first.union(&second).copied().collect();
            assert_eq!(all, expected);
            assert!(first.intersection(&second).count() > 0, "interface");
            assert!(first.difference(&second).count() > 100);
            if version == 1 {
                continue;
            }
            let point = |y| BladePoint {
                tip: Vec3::new(0.0081, y, 0.006),
                axis: Vec3::z(),
                depth_m: 0.02,
            };
            let stroke = CutStroke {
                points: vec![point(0.004), point(0.016)],
                width_m: 0.0,
            };
            cut(&mut topology, &stroke).unwrap();
        }
    }

    #[test]
    fn message_with_too_many_springs_is_cut_short_and_marked() {
        let topology = Topology::new(two_regions().into());
        let drawn = Surface::of(&topology).nodes;
        let all = springs(&topology, &drawn, 0);
        let short = encode(&topology, &drawn, 0, 10);
        assert_eq!((all[1], short[1]), (0, 1));
        assert_eq!(decode(&short, &drawn), decode(&all, &drawn)[..10]);
        assert!(all.len() < 3 * decode(&all, &drawn).len() + HEADER_BYTES);
    }
}
