//! Local change of a coarse lattice after a change of the finer one; the rules are those of [`coarsen`](super::coarsen).
//!
//! A cut only separates: an element splits into several at the same place, and a point into several. Elements and points
//! keep their numbers, and new ones are appended. So only the places of changed cells, and the points of their elements,
//! are looked at.

use std::collections::{BTreeMap, BTreeSet};

use super::brick::{CORNER, LOCALS};
use super::coarsen::{Sets, octant, place, support};
use super::construction::Places;
use super::hierarchy::{Level, Table};
use crate::number_map::NumberMap;

/// The finer cells of a coarse level.
pub(super) trait Cells {
    /// Lattice coordinates of a cell.
    fn at(&self, cell: u32) -> [i32; 3];
    /// Points at its corners.
    fn corners(&self, cell: u32) -> [u32; 8];
    /// Appends the cells joined to it through its upper face on an axis.
    fn joined(&self, cell: u32, axis: usize, list: &mut Vec<u32>);
}

/// An element whose cells changed.
pub(super) struct ChangedElement {
    pub(super) id: u32,
    /// The element that its first cell was part of: itself, or the one that it was split from.
    pub(super) origin: u32,
    /// Its cells, ascending.
    pub(super) cells: Vec<u32>,
}

/// The change of a coarse lattice.
pub(super) struct Recoarsened {
    pub(super) elements: Vec<ChangedElement>,
    /// Corners of all elements with new ones.
    pub(super) corners: Vec<(u32, [u32; 8])>,
    /// The point that each new point was split from.
    pub(super) origins: Vec<u32>,
    /// Elements around points where they changed.
    pub(super) around: Vec<(u32, Vec<u32>)>,
    /// Element and place of the finer points in changed elements; see
    /// [`Prolongation`](super::prolongation::Prolongation).
    pub(super) entries: BTreeMap<u32, u32>,
}

/// Changes of the finer cells.
pub(super) struct Changed {
    /// Each changed cell, and the element of the cell that it was split from if it is new.
    pub(super) cells: BTreeMap<u32, Option<u32>>,
    /// Points that were split, and the new ones, sorted.
    pub(super) points: Vec<u32>,
}

/// Follows changes of the connections or corners of finer cells. `members` are the former cells of each element.
pub(super) fn recoarsen(
    cells: &impl Cells,
    (level, places, members): (&Level, &Places, &Table),
    changed: &Changed,
) -> Recoarsened {
    let elements = split(cells, (level, places, members), &changed.cells);
    let corners = elements.iter().flat_map(|element| {
        let slots = disturbed(cells, element, members, &changed.points);
        let corners = level.corners[element.origin as usize];
        (0..8)
            .filter(move |s| slots >> s & 1 == 1)
            .map(move |s| corners[s])
    });
    let points = sorted(corners.collect());
    let near = elements_near(&elements, (level, members), &points);
    let (corners, origins) = merge(cells, level.points(), &near);
    let mut around: BTreeMap<u32, Vec<u32>> = points.iter().map(|&p| (p, Vec::new())).collect();
    for (element, corners) in near.iter().zip(&corners) {
        for &point in corners {
            if let Some(row) = around.get_mut(&point) {
                row.push(element.id);
            } else if point as usize >= level.points() {
                around.insert(point, vec![element.id]);
            }
        }
    }
    let mut entries = BTreeMap::new();
    for element in &elements {
        for &cell in &element.cells {
            let own = octant(cells.at(cell));
            for (corner, point) in cells.corners(cell).into_iter().enumerate() {
                entries.insert(point, element.id * 32 + CORNER[own][corner] as u32);
            }
        }
    }
    let known = |e: u32| level.corners.get(e as usize).copied();
    let corners = near.iter().map(|e| e.id).zip(corners);
    Recoarsened {
        corners: corners.filter(|(e, c)| known(*e) != Some(*c)).collect(),
        elements,
        origins,
        around: around.into_iter().collect(),
        entries,
    }
}

/// The elements at the places of changed cells whose cells changed, in the order of new numbers.
fn split(
    cells: &impl Cells,
    (level, places, members): (&Level, &Places, &Table),
    changed: &BTreeMap<u32, Option<u32>>,
) -> Vec<ChangedElement> {
    let mut at: BTreeMap<[i32; 3], Vec<(u32, u32)>> = BTreeMap::new();
    for (&cell, new_in) in changed {
        let new = new_in.map(|element| (cell, element));
        at.entry(place(cells.at(cell))).or_default().extend(new);
    }
    let mut count = level.corners.len() as u32;
    let mut elements = Vec::new();
    let mut joined = Vec::new();
    for (at, mut here) in at {
        for e in places.at(at) {
            here.extend(members.row(e).iter().map(|&c| (c, e)));
        }
        here.sort_unstable();
        let mut sets = Sets::new(here.len());
        for (i, &(cell, _)) in here.iter().enumerate() {
            for axis in (0..3).filter(|&axis| cells.at(cell)[axis] & 1 == 0) {
                joined.clear();
                cells.joined(cell, axis, &mut joined);
                for other in &joined {
                    if let Ok(j) = here.binary_search_by_key(other, |h| h.0) {
                        sets.join(i as u32, j as u32);
                    }
                }
            }
        }
        let mut groups: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        for (i, &(cell, _)) in here.iter().enumerate() {
            groups.entry(sets.find(i as u32)).or_default().push(cell);
        }
        let mut kept = BTreeSet::new();
        for (first, group) in groups {
            let origin = here[first as usize].1;
            let id = if kept.insert(origin) {
                origin
            } else {
                count += 1;
                count - 1
            };
            let is_changed =
                group != members.row(origin) || group.iter().any(|c| changed.contains_key(c));
            if is_changed {
                elements.push(ChangedElement {
                    id,
                    origin,
                    cells: group,
                });
            }
        }
    }
    elements
}

/// Slots of a changed element whose points may split, as bits: those that depend on a split or new finer point. All of them if
/// the element lost cells.
fn disturbed(cells: &impl Cells, element: &ChangedElement, members: &Table, points: &[u32]) -> u8 {
    if element.cells != members.row(element.origin) {
        return u8::MAX;
    }
    let mut slots = 0;
    for &cell in &element.cells {
        let own = octant(cells.at(cell));
        for (corner, point) in cells.corners(cell).into_iter().enumerate() {
            if points.binary_search(&point).is_ok() {
                slots |= support(CORNER[own][corner]).fold(0, |bits, (_, slot)| bits | 1 << slot);
            }
        }
    }
    slots
}

fn sorted(mut list: Vec<u32>) -> Vec<u32> {
    list.sort_unstable();
    list.dedup();
    list
}

/// An element with points that are merged again.
struct Near<'a> {
    id: u32,
    /// Its corners before the change.
    former: [u32; 8],
    cells: &'a [u32],
    /// Bit `s` is set where corner `s` is merged again.
    slots: u8,
}

/// All elements at these points, sorted.
fn elements_near<'a>(
    elements: &'a [ChangedElement],
    (level, members): (&Level, &'a Table),
    points: &[u32],
) -> Vec<Near<'a>> {
    let changed: BTreeMap<u32, &ChangedElement> = elements.iter().map(|e| (e.id, e)).collect();
    let others = points.iter().flat_map(|&p| level.around.row(p)).copied();
    let near = others.chain(changed.keys().copied()).collect();
    let element = |id: u32| {
        let change = changed.get(&id);
        let former = level.corners[change.map_or(id, |e| e.origin) as usize];
        let is_merged = |slot: &usize| points.binary_search(&former[*slot]).is_ok();
        Near {
            id,
            former,
            cells: change.map_or_else(|| members.row(id), |e| &e.cells),
            slots: (0..8)
                .filter(is_merged)
                .fold(0, |bits, slot| bits | 1 << slot),
        }
    };
    sorted(near).into_iter().map(element).collect()
}

/// Corners of elements after their points are merged again, and the origin of each new point. `count` is the former number
/// of points.
fn merge(cells: &impl Cells, count: usize, near: &[Near<'_>]) -> (Vec<[u32; 8]>, Vec<u32>) {
    // A finer point merges the slots that it depends on in all elements, by its odd axes.
    let mut slots = Sets::new(near.len() * 8);
    let mut uses: NumberMap<u64, u32> = NumberMap::default();
    uses.reserve(32 * near.len());
    for (element, first) in near.iter().zip((0..).step_by(8)) {
        let mut known = [u32::MAX; LOCALS];
        for &cell in element.cells {
            let own = octant(cells.at(cell));
            for (corner, point) in cells.corners(cell).into_iter().enumerate() {
                let place = CORNER[own][corner];
                if std::mem::replace(&mut known[place], point) == point {
                    continue;
                }
                for (low, slot) in support(place) {
                    if element.slots >> slot & 1 == 1 {
                        let key = u64::from(point) << 3 | low as u64;
                        let own = first + slot as u32;
                        slots.join(*uses.entry(key).or_insert(own), own);
                    }
                }
            }
        }
    }
    let mut number = vec![u32::MAX; near.len() * 8];
    let (mut kept, mut origins) = (BTreeSet::new(), Vec::new());
    let mut corners = Vec::with_capacity(near.len());
    for (element, first) in near.iter().zip((0..).step_by(8)) {
        let mut now = element.former;
        for (slot, point) in now.iter_mut().enumerate() {
            if element.slots >> slot & 1 == 0 {
                continue;
            }
            let number = &mut number[slots.find(first + slot as u32) as usize];
            if *number == u32::MAX {
                *number = if kept.insert(*point) {
                    *point
                } else {
                    origins.push(*point);
                    (count + origins.len() - 1) as u32
                };
            }
            *point = *number;
        }
        corners.push(now);
    }
    (corners, origins)
}
