//! The nodes and cells around a sheet, in a numbering of their own.
//!
//! Nodes of the sheet come first, then the other nodes within three rings of it, then the other corners of their
//! cells. Those, pinned nodes and nodes at the front of earlier cuts stay where they are.

use std::cell::OnceCell;
use std::collections::hash_map::Entry;

use super::DRIFT_MAX;
use super::freedom::{Freedom, freedom};
use super::ribbon::Ribbon;
use super::soundness::{CORNER_FLOOR, SPRING_FLOOR, Soundness};
use crate::cell::NO_CELL;
use crate::number_map::NumberMap;
use crate::{FaceId, Topology, Vec3};

/// Rings of neighbours around the sheet that make room for it.
const RINGS: usize = 3;
/// Halvings of the way of a node before it stays.
const HALVINGS: u8 = 6;

pub(crate) struct Patch {
    /// Number of each node in the topology.
    pub(crate) ids: Vec<u32>,
    /// Where each node stood before the cut.
    pub(crate) start: Vec<Vec3>,
    /// Where it is now.
    pub(crate) at: Vec<Vec3>,
    /// Nodes of the sheet; they come first.
    pub(crate) sheet: usize,
    /// Nodes that may move; they come before the others.
    pub(crate) movable: usize,
    /// The directions left to each of these.
    pub(crate) holds: Vec<Freedom>,
    /// Number of each cell in the topology.
    pub(crate) cell_ids: Vec<u32>,
    /// Corners of each cell.
    pub(crate) cells: Vec<[u32; 8]>,
    /// Cells around each movable node, [`NO_CELL`] where there is none.
    pub(crate) around: Vec<[u32; 8]>,
    /// The floors of all cells.
    floor: Soundness,
    /// Displacement of each node of the sheet to the positive side of the wound when that opens.
    half_widths: Vec<Vec3>,
    /// The side of the wound, 1 or -1, of each cell that its opening deforms; 0 for others.
    sides: Vec<f64>,
    /// Floors of single cells, since they were first asked for.
    floors: Vec<OnceCell<Soundness>>,
    pub(crate) spacing: f64,
}

/// The nearest place to `x` to which cuts may move a node from where it was built.
pub(crate) fn within_drift(x: Vec3, built: &Vec3, spacing: f64) -> Vec3 {
    let (way, limit) = (x - built, DRIFT_MAX * spacing);
    let size = way.norm();
    if size > limit {
        built + way * (limit / size)
    } else {
        x
    }
}

/// The corners of a cell whose nodes all are in the sheet, which has this many: each with its three neighbours.
pub(crate) fn corners_in_sheet(
    corners: &[u32; 8],
    sheet: usize,
) -> impl Iterator<Item = [usize; 4]> + '_ {
    let four = (0..8_usize).map(|c| [c, c ^ 1, c ^ 2, c ^ 4].map(|i| corners[i] as usize));
    four.filter(move |four| four.iter().all(|&n| n < sheet))
}

impl Patch {
    /// The patch around the nodes of a sheet.
    pub(crate) fn around(topology: &Topology, sheet: &[u32]) -> Self {
        let mut ids: Vec<u32> = sheet.to_vec();
        let mut places: NumberMap<u32, u32> = (0..).zip(sheet).map(|(i, &n)| (n, i)).collect();
        let mut holds: Vec<Freedom> = sheet.iter().map(|&n| freedom(topology, n)).collect();
        let mut front = ids.clone();
        for _ in 0..RINGS {
            let mut next = Vec::new();
            for &node in &front {
                for (slot, &cell) in topology.node_cells[node as usize].iter().enumerate() {
                    if cell != NO_CELL {
                        let corners = topology.corners(cell);
                        let others = [1, 2, 4].map(|step| corners[slot ^ step]);
                        // Nodes that may not move are numbered at the end.
                        for other in others {
                            if let Entry::Vacant(place) = places.entry(other) {
                                place.insert(u32::MAX);
                                next.push(other);
                            }
                        }
                    }
                }
            }
            next.sort_unstable();
            for &node in &next {
                let hold = freedom(topology, node);
                if hold != Freedom::Pinned && !topology.is_at_front(node) {
                    places.insert(node, ids.len() as u32);
                    ids.push(node);
                    holds.push(hold);
                }
            }
            front = next;
        }
        let movable = ids.len();
        let mut cell_ids = Vec::with_capacity(2 * movable);
        for &node in &ids {
            let cells = topology.node_cells[node as usize];
            cell_ids.extend(cells.into_iter().filter(|&c| c != NO_CELL));
        }
        cell_ids.sort_unstable();
        cell_ids.dedup();
        let mut cells = Vec::with_capacity(cell_ids.len());
        for &cell in &cell_ids {
            cells.push(topology.corners(cell).map(|node| {
                let place = places.entry(node).or_insert(u32::MAX);
                if *place == u32::MAX {
                    *place = ids.len() as u32;
                    ids.push(node);
                }
                *place
            }));
        }
        let mut around = vec![[NO_CELL; 8]; movable];
        for (c, corners) in (0..).zip(&cells) {
            for (slot, &node) in corners.iter().enumerate() {
                if (node as usize) < movable {
                    around[node as usize][slot] = c;
                }
            }
        }
        let start: Vec<Vec3> = ids.iter().map(|&n| topology.rest(n)).collect();
        let spacing = topology.model.spacing_m;
        Self {
            at: start.clone(),
            start,
            ids,
            holds,
            sheet: sheet.len(),
            movable,
            cell_ids,
            floors: vec![OnceCell::new(); cells.len()],
            half_widths: Vec::new(),
            sides: vec![0.0; cells.len()],
            cells,
            around,
            floor: Soundness {
                volume: CORNER_FLOOR * spacing.powi(3),
                spring: (SPRING_FLOOR * spacing).powi(2),
            },
            spacing,
        }
    }

    pub(crate) fn corners(&self, cell: usize) -> [Vec3; 8] {
        self.cells[cell].map(|n| self.at[n as usize])
    }

    /// Takes how far each node of the sheet will go to the positive side when the wound opens. That deforms a cell with a corner
    /// that lies in the sheet and whose nodes do not go equally far; such a cell has to be sound then, too.
    pub(crate) fn expect_opening(&mut self, half_widths: Vec<Vec3>, ribbon: &Ribbon) {
        for (side, corners) in self.sides.iter_mut().zip(&self.cells) {
            let w = |n: usize| half_widths[n];
            let mut steps = corners_in_sheet(corners, self.sheet);
            if steps.any(|four| four.iter().any(|&n| w(n) != w(four[0]))) {
                let start = corners.map(|n| self.start[n as usize]);
                let centre = start.iter().sum::<Vec3>() / 8.0;
                if let Some(foot) = ribbon.nearest(&centre) {
                    *side = (centre - foot.point).dot(&foot.normal).signum();
                }
            }
        }
        self.half_widths = half_widths;
    }

    /// The corners of a cell when the wound opens, if that deforms it.
    pub(crate) fn opened(&self, cell: usize) -> Option<[Vec3; 8]> {
        let side = self.sides[cell];
        let place = |n: u32| {
            let half = self.half_widths.get(n as usize);
            self.at[n as usize] + half.map_or(Vec3::zeros(), |half| half * side)
        };
        (side != 0.0).then(|| self.cells[cell].map(place))
    }

    /// Least corner volume and spring length of a cell: the floors, or those before the cut where they are less.
    pub(crate) fn floor(&self, cell: usize) -> Soundness {
        let floor = || {
            let start = self.cells[cell].map(|n| self.start[n as usize]);
            Soundness::of(&start).min(&self.floor)
        };
        *self.floors[cell].get_or_init(floor)
    }

    /// Whether a cell is not below its floor, now and when the wound opens.
    pub(crate) fn is_sound(&self, cell: usize) -> bool {
        let is_sound = |x: &[Vec3; 8]| {
            let now = Soundness::of(x);
            now.is_above(&self.floor) || now.is_above(&self.floor(cell))
        };
        is_sound(&self.corners(cell)) && self.opened(cell).is_none_or(|x| is_sound(&x))
    }

    /// Whether each cell has a corner that moved. The others are as sound as before.
    pub(crate) fn changed(&self) -> Vec<bool> {
        let is_moved: Vec<bool> = self
            .at
            .iter()
            .zip(&self.start)
            .map(|(x, o)| x != o)
            .collect();
        let any = |corners: &[u32; 8]| corners.iter().any(|&n| is_moved[n as usize]);
        self.cells.iter().map(any).collect()
    }

    /// Cells that are not sound.
    pub(crate) fn unsound(&self) -> Vec<usize> {
        let changed = self.changed().into_iter().enumerate();
        let changed = changed.filter_map(|(c, is_changed)| is_changed.then_some(c));
        changed.filter(|&c| !self.is_sound(c)).collect()
    }

    /// Takes back the ways of nodes, half by half, until all cells are sound.
    pub(crate) fn backtrack(&mut self) {
        let target: Vec<Vec3> = self.at[..self.movable].to_vec();
        let mut halvings = vec![0_u8; self.movable];
        let mut suspects: Vec<u32> = self.unsound().into_iter().map(|c| c as u32).collect();
        while !suspects.is_empty() {
            let mut back: Vec<u32> = Vec::new();
            for &cell in &suspects {
                let c = cell as usize;
                if !self.is_sound(c) {
                    let nodes = self.cells[c].into_iter();
                    back.extend(nodes.filter(|&n| {
                        (n as usize) < self.movable && self.at[n as usize] != self.start[n as usize]
                    }));
                }
            }
            back.sort_unstable();
            back.dedup();
            suspects.clear();
            for &node in &back {
                let n = node as usize;
                halvings[n] += 1;
                self.at[n] = if halvings[n] > HALVINGS {
                    self.start[n]
                } else {
                    let part = 1.0 / f64::from(1_u32 << halvings[n]);
                    self.start[n] + (target[n] - self.start[n]) * part
                };
                suspects.extend(self.around[n].into_iter().filter(|&c| c != NO_CELL));
            }
            suspects.sort_unstable();
            suspects.dedup();
        }
    }
}

impl Topology {
    /// Whether a node belongs to the wall of a cut, and was doubled there.
    pub(crate) fn is_at_wall(&self, node: u32) -> bool {
        self.has_open_face(node, false)
    }

    /// Whether a node belongs to the front of a cut, where both sides of an opened face share it.
    fn is_at_front(&self, node: u32) -> bool {
        self.has_open_face(node, true)
    }

    /// Whether a face at a node was opened whose other side has the node too, or has not.
    fn has_open_face(&self, node: u32, is_shared: bool) -> bool {
        let cells = self.node_cells[node as usize];
        cells.iter().enumerate().any(|(slot, &cell)| {
            cell != NO_CELL
                && (0..3).any(|axis| {
                    let face = FaceId::new(cell, 2 * axis + (slot >> axis & 1));
                    self.is_opened(face)
                        && (cells[slot ^ (1 << axis)] == self.behind(face).cell()) == is_shared
                })
        })
    }

    /// Whether a cut opened a face.
    pub(crate) fn is_opened(&self, face: FaceId) -> bool {
        self.across(face) == NO_CELL
            && self.model.cells[face.cell() as usize].neighbours[face.face()] != NO_CELL
    }
}
