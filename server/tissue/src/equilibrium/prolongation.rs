//! Trilinear interpolation from the corners of a coarse element to the points within it (prolongation); its
//! transpose takes forces the other way (restriction).

use super::brick::LOCALS;
use super::element::WEIGHTS;
use super::quad::{Quad, ZERO, plus, reserve, trim};

/// Entry of a point that follows no coarse element.
pub(crate) const FREE: u32 = u32::MAX;

/// The corners with a nonzero weight at one of the 27 places of an element, ascending, and their common weight.
#[derive(Clone, Copy)]
pub(crate) struct Stencil {
    corners: [u8; 8],
    len: u8,
    weight: f32,
}

/// Stencil of each place.
pub(crate) const STENCILS: [Stencil; LOCALS] = stencils();

const fn stencils() -> [Stencil; LOCALS] {
    let none = Stencil {
        corners: [0; 8],
        len: 0,
        weight: 0.0,
    };
    let mut list = [none; LOCALS];
    let mut place = 0;
    while place < LOCALS {
        let stencil = &mut list[place];
        let mut c = 0;
        while c < 8 {
            if WEIGHTS[place][c] > 0.0 {
                stencil.corners[stencil.len as usize] = c as u8;
                stencil.len += 1;
                stencil.weight = WEIGHTS[place][c] as f32;
            }
            c += 1;
        }
        place += 1;
    }
    list
}

impl Stencil {
    /// The corners and their weight.
    #[inline(always)]
    pub(crate) fn corners(&self) -> impl Iterator<Item = (usize, f32)> {
        let corners = self.corners[..self.len as usize].iter();
        corners.map(|&c| (usize::from(c), self.weight))
    }
}

/// Sets an item. Missing items before it become equal to it, until they are set.
pub(crate) fn set<T: Copy>(items: &mut Vec<T>, at: u32, item: T) {
    let at = at as usize;
    if items.len() <= at {
        items.resize(at + 1, item);
    }
    items[at] = item;
}

/// The prolongation operator of one level. It stores element and place of each point (4 bytes) instead of rows of
/// indices and weights (68 bytes), which exceed the cache.
#[derive(Clone)]
pub(crate) struct Prolongation {
    /// Coarse element and place, as `element * 32 + place`, or [`FREE`].
    entries: Vec<u32>,
    /// Points at the corners of the coarse elements.
    corners: Vec<[u32; 8]>,
}

impl Prolongation {
    pub(crate) fn new(entries: Vec<u32>, corners: Vec<[u32; 8]>) -> Self {
        Self { entries, corners }
    }

    /// Sets the entry of a point, which may be new.
    pub(crate) fn set_entry(&mut self, point: u32, entry: u32) {
        set(&mut self.entries, point, entry);
    }

    /// Sets the corners of a coarse element, which may be new.
    pub(crate) fn set_corners(&mut self, element: u32, corners: [u32; 8]) {
        set(&mut self.corners, element, corners);
    }

    /// Removes the points and elements from these numbers on.
    pub(crate) fn truncate(&mut self, points: usize, elements: usize) {
        trim(&mut self.entries, points);
        trim(&mut self.corners, elements);
    }

    /// Makes room for the points and elements that cuts will add.
    pub(crate) fn reserve(&mut self) {
        reserve(&mut self.entries);
        reserve(&mut self.corners);
    }

    /// Number of points of the finer level.
    pub(crate) fn len(&self) -> usize {
        self.entries.len()
    }

    /// The entry of a point.
    pub(crate) fn entry(&self, point: u32) -> u32 {
        self.entries[point as usize]
    }

    /// The coarse element that a point follows.
    #[inline]
    pub(crate) fn element_of(&self, point: usize) -> Option<u32> {
        let entry = self.entries[point];
        (entry != FREE).then_some(entry / 32)
    }

    /// Coarse points that a point follows, and their weights.
    #[inline(always)]
    pub(crate) fn row(&self, point: usize) -> impl Iterator<Item = (u32, f32)> {
        let entry = self.entries[point];
        let row = (entry != FREE).then(|| {
            let corners = &self.corners[(entry / 32) as usize];
            let stencil = &STENCILS[(entry % 32) as usize];
            stencil.corners().map(|(c, weight)| (corners[c], weight))
        });
        row.into_iter().flatten()
    }

    /// Interpolates coarse values at a point.
    #[inline(always)]
    pub(crate) fn interpolate(&self, point: usize, of: &[Quad]) -> Quad {
        let row = self.row(point);
        row.fold(ZERO, |sum, (p, w)| plus(&sum, w, &of[p as usize]))
    }

    /// The same in double precision.
    #[inline(always)]
    pub(crate) fn interpolate_exactly(&self, point: usize, of: &[[f64; 3]]) -> [f64; 3] {
        let mut sum = [0.0; 3];
        for (p, w) in self.row(point) {
            for (sum, v) in sum.iter_mut().zip(of[p as usize]) {
                *sum += f64::from(w) * v;
            }
        }
        sum
    }
}
