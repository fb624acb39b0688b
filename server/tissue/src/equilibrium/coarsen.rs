//! Construction of the next coarser lattice over the cells of any level: elements, points and parents.
//!
//! Two by two by two cells form an element if they are connected through faces. Cells on two sides of a cut, or of a
//! gap between two fingers, form two elements at the same place. Corners of elements merge into one point where a finer
//! point depends on both. So coarse lattices open where the fine lattice does, and the trilinear weights of a point do
//! not depend on the element that evaluates them.

use std::collections::BTreeMap;

use super::brick::{CORNER, LOCALS};
use super::prolongation::FREE;

/// A cell of some level, as input of the next coarser one.
#[derive(Clone, Copy)]
pub(crate) struct Piece {
    /// Lattice coordinates in units of its own side.
    pub(crate) at: [i32; 3],
    /// Points at its corners.
    pub(crate) corners: [u32; 8],
}

/// A coarser lattice.
pub(crate) struct Coarse {
    /// Its elements, sorted by place.
    pub(crate) pieces: Vec<Piece>,
    /// Element of every finer cell.
    pub(crate) element_of: Vec<u32>,
    /// Element and place of every finer point, see [`Prolongation`](super::prolongation::Prolongation).
    pub(crate) entries: Vec<u32>,
    /// Number of its points.
    pub(crate) points: usize,
}

/// Position (0..8) of a cell in its element.
pub(crate) fn octant(at: [i32; 3]) -> usize {
    (at[0] & 1) as usize | ((at[1] & 1) as usize) << 1 | ((at[2] & 1) as usize) << 2
}

pub(crate) fn place(at: [i32; 3]) -> [i32; 3] {
    at.map(|v| v.div_euclid(2))
}

/// Makes the coarser lattice. `points` is the number of finer points; `joined(a, axis, list)` appends the cells
/// connected to cell `a` through its face towards higher coordinates on an axis.
pub(crate) fn coarsen(
    cells: &[Piece],
    points: usize,
    joined: impl Fn(u32, usize, &mut Vec<u32>),
) -> Coarse {
    // Cells of one place, in order.
    let mut order: Vec<u32> = (0..cells.len() as u32).collect();
    let key = |c: u32| {
        let at = place(cells[c as usize].at);
        (at[2], at[1], at[0])
    };
    order.sort_unstable_by_key(|&c| (key(c), c));
    // Components within a place.
    let mut sets = Sets::new(cells.len());
    let mut list = Vec::new();
    for c in 0..cells.len() as u32 {
        for axis in 0..3 {
            if cells[c as usize].at[axis] & 1 == 0 {
                list.clear();
                joined(c, axis, &mut list);
                for &other in &list {
                    sets.join(c, other);
                }
            }
        }
    }
    let mut element_of = vec![u32::MAX; cells.len()];
    let mut pieces: Vec<Piece> = Vec::new();
    for &c in &order {
        let root = sets.find(c);
        if element_of[root as usize] == u32::MAX {
            element_of[root as usize] = pieces.len() as u32;
            pieces.push(Piece {
                at: place(cells[c as usize].at),
                corners: [u32::MAX; 8],
            });
        }
    }
    for c in 0..cells.len() as u32 {
        element_of[c as usize] = element_of[sets.find(c) as usize];
    }
    let (entries, count) = merge_corners(cells, points, &element_of, &mut pieces);
    Coarse {
        pieces,
        element_of,
        entries,
        points: count,
    }
}

/// Merges all corners that a finer point depends on, and numbers them. Returns the element and place of each finer
/// point, and the number of coarse points.
fn merge_corners(
    cells: &[Piece],
    points: usize,
    element_of: &[u32],
    pieces: &mut [Piece],
) -> (Vec<u32>, usize) {
    const NONE: u32 = u32::MAX;
    let mut slots = Sets::new(pieces.len() * 8);
    let mut first = vec![[NONE; 8]; points];
    let mut entries = vec![FREE; points];
    for (c, cell) in cells.iter().enumerate() {
        let element = element_of[c];
        let own = octant(cell.at);
        for (corner, &point) in cell.corners.iter().enumerate() {
            // Any other element around the point gives the same weights and merged corners.
            let place = CORNER[own][corner];
            entries[point as usize] = element * 32 + place as u32;
            let known = &mut first[point as usize];
            for (low, slot) in support(place) {
                let slot = element * 8 + slot as u32;
                if known[low] == NONE {
                    known[low] = slot;
                } else {
                    slots.join(known[low], slot);
                }
            }
        }
    }
    let mut number = vec![NONE; pieces.len() * 8];
    let mut count = 0;
    for (e, piece) in pieces.iter_mut().enumerate() {
        for s in 0..8 {
            let root = slots.find((e * 8 + s) as u32) as usize;
            if number[root] == NONE {
                number[root] = count;
                count += 1;
            }
            piece.corners[s] = number[root];
        }
    }
    (entries, count as usize)
}

/// Corners of an element on which the finer point at a place (see [`CORNER`]) depends: for each, its number among those of
/// the point (by odd axes) and the slot of the element.
pub(crate) fn support(place: usize) -> impl Iterator<Item = (usize, usize)> {
    let (list, count) = &SUPPORT[place];
    list[..*count]
        .iter()
        .map(|&(low, slot)| (low.into(), slot.into()))
}

static SUPPORT: [([(u8, u8); 8], usize); LOCALS] = {
    let mut all = [([(0, 0); 8], 0); LOCALS];
    let mut place = 0;
    while place < LOCALS {
        let at = [place % 3, place / 3 % 3, place / 9];
        let mut low = 0;
        while low < 8 {
            let (mut slot, mut is_one, mut a) = (0, true, 0);
            while a < 3 {
                let bit = low >> a & 1;
                match at[a] {
                    1 => slot |= bit << a,
                    high => {
                        is_one &= bit == 0;
                        slot |= (high as u8 / 2) << a;
                    }
                }
                a += 1;
            }
            if is_one {
                let (list, count) = &mut all[place];
                list[*count] = (low, slot);
                *count += 1;
            }
            low += 1;
        }
        place += 1;
    }
    all
};

/// Face connections between elements, by the points of the shared face.
pub(crate) struct Joints {
    at: BTreeMap<[i32; 3], Vec<u32>>,
}

impl Joints {
    pub(crate) fn new(pieces: &[Piece]) -> Self {
        let mut at: BTreeMap<[i32; 3], Vec<u32>> = BTreeMap::new();
        for (i, piece) in pieces.iter().enumerate() {
            at.entry(piece.at).or_default().push(i as u32);
        }
        Self { at }
    }

    /// Appends the elements behind the face of `a` towards higher coordinates that share all its points.
    pub(crate) fn behind(&self, pieces: &[Piece], a: u32, axis: usize, list: &mut Vec<u32>) {
        let own = &pieces[a as usize];
        let mut to = own.at;
        to[axis] += 1;
        let shares = |other: &u32| {
            let corners = &pieces[*other as usize].corners;
            (0..8)
                .filter(|c| c >> axis & 1 == 0)
                .all(|c| corners[c] == own.corners[c | 1 << axis])
        };
        let there = self.at.get(&to);
        list.extend(there.into_iter().flatten().copied().filter(shares));
    }
}

/// Disjoint sets; the root of a set is its lowest member.
pub(crate) struct Sets {
    parent: Vec<u32>,
}

impl Sets {
    pub(crate) fn new(len: usize) -> Self {
        Self {
            parent: (0..len as u32).collect(),
        }
    }

    pub(crate) fn find(&mut self, mut a: u32) -> u32 {
        while self.parent[a as usize] != a {
            let up = self.parent[self.parent[a as usize] as usize];
            self.parent[a as usize] = up;
            a = up;
        }
        a
    }

    pub(crate) fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.find(a), self.find(b));
        if a < b {
            self.parent[b as usize] = a;
        } else {
            self.parent[a as usize] = b;
        }
    }
}
