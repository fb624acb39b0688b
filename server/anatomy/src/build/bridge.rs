//! Reconnecting pieces of a region that are one part in the input (reconstructed).
//!
//! A rod or a neck thinner than a cell rarely fills most of one, so a part of a region is split into pieces.
//! The rays that measured the fill of the cells know which pieces were one part, and through which cells that
//! part runs from one piece to the next. The path of cells with the least missing volume becomes cells of the
//! region. Nodes are projected onto its surface afterwards, so the bridge gets its true thickness.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BinaryHeap};

use super::grid::Grid;
use super::label::Labels;
use super::lattice::face_neighbours;
use super::mending::pieces;
use super::walls::{Share, Walls, in_margin};
use crate::surface::Sets;

/// A cell may carry a bridge only if the part fills at least this much of it.
const FILLED_MIN: f64 = 0.01;
/// Cost of a face at which regions would touch that do not touch in the input, in empty cells.
const FALSE_FACE: f64 = 0.5;
/// Most cells that are visited for one bridge: a path of ten cells among its neighbours.
const LOOK_MAX: usize = 4096;

/// Joins pieces of a region that are one part in the input; returns the number of bridges.
pub(super) fn build_bridges(grid: &Grid, labels: &mut Labels, walls: &Walls) -> usize {
    let (mut piece_of, sizes) = pieces(grid, labels, |a, b| a == b);
    let mut joined = Sets::new(sizes.len());
    let mut bridges = 0;
    for own in torn(grid, labels, walls, &piece_of, &sizes) {
        for &piece in &own.pieces[1..] {
            let search = Search {
                grid,
                labels,
                walls,
                own: &own,
                piece_of: &piece_of,
            };
            let Some(way) = search.way(&mut joined, piece) else {
                continue;
            };
            for cell in way {
                labels.fix_label(cell, own.label);
                piece_of[cell] = piece;
            }
            bridges += 1;
        }
    }
    bridges
}

/// A part of a region that lies in several pieces.
struct Torn {
    label: u8,
    part: u32,
    /// The pieces, the largest first.
    pieces: Vec<u32>,
    /// The cells around each piece, and the cells of each piece that other regions fill in part.
    rims: BTreeMap<u32, Vec<usize>>,
}

/// Finds the part that each piece belongs to, and the parts with several pieces.
fn torn(
    grid: &Grid,
    labels: &Labels,
    walls: &Walls,
    piece_of: &[u32],
    sizes: &[usize],
) -> Vec<Torn> {
    // Volume of each part in each piece.
    let mut has: BTreeMap<(u32, u32), (u8, f64)> = BTreeMap::new();
    for (cell, label) in labels.label.iter().enumerate().filter(|(_, l)| **l != 0) {
        for share in walls.shares_of(cell).iter().filter(|s| s.label == *label) {
            let entry = has.entry((piece_of[cell], share.part)).or_default();
            entry.0 = *label;
            entry.1 += share.filled();
        }
    }
    let mut part_of: BTreeMap<u32, (u8, u32, f64)> = BTreeMap::new();
    for ((piece, part), (label, much)) in has {
        let best = part_of.entry(piece).or_insert((label, part, much));
        if much > best.2 {
            *best = (label, part, much);
        }
    }
    let mut parts: BTreeMap<(u8, u32), Vec<u32>> = BTreeMap::new();
    for (piece, (label, part, _)) in part_of {
        parts.entry((label, part)).or_default().push(piece);
    }
    parts.retain(|_, pieces| pieces.len() > 1);
    let mut torn: Vec<Torn> = Vec::new();
    let mut of_piece: BTreeMap<u32, usize> = BTreeMap::new();
    for ((label, part), mut pieces) in parts {
        pieces.sort_by_key(|p| (usize::MAX - sizes[*p as usize], *p));
        of_piece.extend(pieces[1..].iter().map(|p| (*p, torn.len())));
        let rims = BTreeMap::new();
        torn.push(Torn {
            label,
            part,
            pieces,
            rims,
        });
    }
    for (cell, piece) in piece_of.iter().enumerate() {
        let Some(&own) = of_piece.get(piece) else {
            continue;
        };
        let mut others = face_neighbours(grid, cell).into_iter().flatten();
        if others.any(|o| piece_of[o] != *piece) {
            torn[own].rims.entry(*piece).or_default().push(cell);
        }
    }
    torn
}

struct Search<'a> {
    grid: &'a Grid,
    labels: &'a Labels,
    walls: &'a Walls,
    own: &'a Torn,
    piece_of: &'a [u32],
}

/// A cell reached at a cost; the cheapest comes first.
#[derive(PartialEq)]
struct Reached {
    cost: f64,
    cell: usize,
}

impl Eq for Reached {}

impl Ord for Reached {
    fn cmp(&self, other: &Self) -> Ordering {
        let by_cost = other.cost.total_cmp(&self.cost);
        by_cost.then(other.cell.cmp(&self.cell))
    }
}

impl PartialOrd for Reached {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Search<'_> {
    /// The cells to give the region so that a piece of the part connects to another one, which `joined`
    /// records. Empty when there is no path.
    fn way(&self, joined: &mut Sets, piece: u32) -> Option<Vec<usize>> {
        let mut queue = BinaryHeap::new();
        let mut from: BTreeMap<usize, (f64, usize)> = BTreeMap::new();
        for &cell in self.own.rims.get(&piece)? {
            from.insert(cell, (0.0, cell));
            queue.push(Reached { cost: 0.0, cell });
        }
        let most = from.len() + LOOK_MAX;
        while let Some(Reached { cost, cell }) = queue.pop() {
            if from[&cell].0 < cost {
                continue;
            }
            for next in face_neighbours(self.grid, cell).into_iter().flatten() {
                if self.labels.label[next] == self.own.label {
                    let found = self.piece_of[next];
                    if self.own.pieces.contains(&found) && joined.join(piece, found) {
                        return Some(way_back(&from, cell));
                    }
                    continue;
                }
                let Some(more) = self.cost(next) else {
                    continue;
                };
                let cost = cost + more;
                if from.len() < most && from.get(&next).is_none_or(|f| cost < f.0) {
                    from.insert(next, (cost, cell));
                    queue.push(Reached { cost, cell: next });
                }
            }
        }
        None
    }

    /// Missing volume of the region in a cell, if the part runs through it.
    fn cost(&self, cell: usize) -> Option<f64> {
        let shares = self.walls.shares_of(cell).iter();
        let own = shares.filter(|s| s.label == self.own.label && s.part == self.own.part);
        let filled: f64 = own.map(Share::filled).sum();
        if filled < FILLED_MIN || in_margin(self.grid, cell) {
            return None;
        }
        let walls = self.walls;
        let won = walls.false_faces_won(self.grid, self.labels, cell, self.own.label);
        Some(1.0 - filled + FALSE_FACE * f64::from(won.max(0)))
    }
}

/// The cells on the path back to the piece, without the piece's own.
fn way_back(from: &BTreeMap<usize, (f64, usize)>, mut cell: usize) -> Vec<usize> {
    let mut way = Vec::new();
    while from[&cell].1 != cell {
        way.push(cell);
        cell = from[&cell].1;
    }
    way
}
