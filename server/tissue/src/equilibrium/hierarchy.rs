//! Coarse lattices over the lattice that the nodes came from, and their operators.
//!
//! A snapped lattice is still a lattice: node (i, j, k) hangs on the coarse points around
//! (i/2, j/2, k/2) with trilinear weights w. With u = P e the energy at rest becomes ½ eᵀ(PᵀAP)e, A
//! being the stiffness of the length law at rest, k [n nᵀ + σ (I - n nᵀ)] per spring with the floor σ
//! of `law.rs`. A spring between i and j sees
//! of coarse point I the part `d_I = w_iI - w_jI`, so
//!
//! ```text
//! (PᵀAP)_IJ = Σ over springs  k [n nᵀ + σ (I - n nᵀ)] d_I d_J
//! ```
//!
//! and all J lie within one step of I: a row is 27 blocks. Pinned nodes have no weights. Nodes
//! doubled by a cut hang on the same coarse points as their originals: what opens the cut is then
//! left to the fine level, and the coarse ones stay symmetric and positive.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::block::{Block, EMPTY, Quad, ZERO, add_scaled, inverse, outer};
use super::lattice::coordinates;
use super::law::sideways;
use crate::{Topology, Vec3};

/// Coarse levels at most: 8 halvings take a lattice of 256 points per axis to one.
const LEVELS_MAX: usize = 8;
/// A level this small is not made coarser: sweeping it costs less than a microsecond per point.
const COARSEST_POINTS: usize = 48;
/// No such point.
pub(crate) const NONE: u32 = u32::MAX;

/// A point of a neighbouring level and the weight that ties to it.
pub(crate) type Tie = (u32, f32);

/// Up to eight ties, in one piece of memory.
#[derive(Clone, Copy, Default)]
pub(crate) struct Ties {
    ties: [Tie; 8],
    len: u8,
}

impl Ties {
    fn push(&mut self, tie: Tie) {
        self.ties[self.len as usize] = tie;
        self.len += 1;
    }
}

impl std::ops::Deref for Ties {
    type Target = [Tie];

    #[inline]
    fn deref(&self) -> &[Tie] {
        &self.ties[..self.len as usize]
    }
}

/// One coarse lattice: constant parts first, then the state of a cycle.
pub(crate) struct Level {
    pub(crate) at: Vec<[i32; 3]>,
    /// Points around each point, in the order of [`slot`]; absent ones are `at.len()`.
    pub(crate) around: Vec<[u32; 27]>,
    pub(crate) rows: Vec<[Block; 27]>,
    pub(crate) inverse: Vec<Block>,
    /// Mean stiffness of each point in N/m.
    pub(crate) own: Vec<f32>,
    /// Points (or nodes) of the finer level under each point.
    pub(crate) children: Vec<Vec<Tie>>,
    /// Points of the next coarser level above each point; empty on the coarsest.
    pub(crate) parents: Vec<Ties>,

    /// Correction, with one point more that is always zero.
    pub(crate) e: Vec<Quad>,
    pub(crate) rhs: Vec<Quad>,
    pub(crate) live: List,
    pub(crate) loaded: List,
    pub(crate) smoothed: List,
    pub(crate) ring: List,

    /// Row of added stiffness of each point (contacts, held nodes), or [`NONE`].
    pub(crate) extra_of: Vec<u32>,
    pub(crate) extra: Vec<Extra>,
}

/// What contacts add to one row.
pub(crate) struct Extra {
    pub(crate) point: u32,
    pub(crate) row: [Block; 27],
    pub(crate) inverse: Block,
}

/// A set of indices that is emptied in the time it took to fill.
#[derive(Default)]
pub(crate) struct List {
    pub(crate) items: Vec<u32>,
    member: Vec<bool>,
}

impl List {
    pub(crate) fn grow(&mut self, len: usize) {
        self.member.resize(len, false);
        let more = len.saturating_sub(self.items.len());
        self.items.reserve(more);
    }

    #[inline]
    pub(crate) fn insert(&mut self, item: u32) -> bool {
        let member = &mut self.member[item as usize];
        let new = !*member;
        if new {
            *member = true;
            self.items.push(item);
        }
        new
    }

    #[inline]
    pub(crate) fn contains(&self, item: u32) -> bool {
        self.member[item as usize]
    }

    pub(crate) fn clear(&mut self) {
        for item in self.items.drain(..) {
            self.member[item as usize] = false;
        }
    }

    /// Puts the items in order; cheap when most of them are.
    pub(crate) fn sort(&mut self) {
        // Merges the sorted run of old items with the tail of new ones.
        if !self.items.is_sorted() {
            self.items.sort_unstable();
        }
    }

    /// Keeps the items for which `keep` holds, in their order.
    pub(crate) fn retain(&mut self, mut keep: impl FnMut(u32) -> bool) {
        let member = &mut self.member;
        self.items.retain(|&item| {
            let stays = keep(item);
            member[item as usize] = stays;
            stays
        });
    }
}

/// All coarse levels, from the finest, and what the nodes hang on.
pub(crate) struct Hierarchy {
    /// Ties of each node to the first level; none for pinned nodes.
    pub(crate) parents: Vec<Ties>,
    pub(crate) levels: Vec<Level>,
}

/// Position of `to` in a row of `from`.
#[inline]
pub(crate) fn slot(from: [i32; 3], to: [i32; 3]) -> Option<usize> {
    let d: [i32; 3] = std::array::from_fn(|a| to[a] - from[a] + 1);
    d.iter()
        .all(|v| (0..3).contains(v))
        .then(|| (d[0] + 3 * d[1] + 9 * d[2]) as usize)
}

/// Coarse points around a lattice point with their trilinear weights.
fn ties_of(at: [i32; 3]) -> impl Iterator<Item = ([i32; 3], f32)> {
    let low = at.map(|v| v.div_euclid(2));
    let odd = at.map(|v| v.rem_euclid(2));
    (0..8).filter_map(move |c: i32| {
        let step = [c & 1, c >> 1 & 1, c >> 2 & 1];
        let mut weight = 1.0;
        for a in 0..3 {
            if odd[a] == 1 {
                weight *= 0.5;
            } else if step[a] == 1 {
                return None;
            }
        }
        Some((std::array::from_fn(|a| low[a] + step[a]), weight))
    })
}

impl Hierarchy {
    pub(crate) fn new(topology: &Topology) -> Self {
        let nodes: Vec<[i32; 3]> = (0..topology.node_count() as u32)
            .map(|n| coordinates(topology, n))
            .collect();
        let free = |n: usize| !topology.is_pinned(n as u32);
        let (first, parents) = Level::over(&nodes, free);
        let mut levels = vec![first];
        while levels.len() < LEVELS_MAX {
            let finer = levels.last_mut().expect("there is a first level");
            if finer.at.len() <= COARSEST_POINTS {
                break;
            }
            let (next, ties) = Level::over(&finer.at, |_| true);
            if next.at.len() >= finer.at.len() {
                break;
            }
            finer.parents = ties;
            levels.push(next);
        }
        let mut hierarchy = Self { parents, levels };
        let all = |level: &Level| (0..level.at.len() as u32).collect::<Vec<_>>();
        for l in 0..hierarchy.levels.len() {
            let points = all(&hierarchy.levels[l]);
            hierarchy.assemble(topology, l, &points);
        }
        hierarchy
    }

    /// Follows a cut: ties of new nodes, then the rows of all coarse points over touched nodes.
    pub(crate) fn follow(&mut self, topology: &Topology, touched: &[u32]) {
        let known = self.parents.len();
        let count = topology.node_count();
        self.parents.resize(count, Ties::default());
        let first = &mut self.levels[0];
        let index: BTreeMap<[i32; 3], u32> = if count > known {
            (0..).zip(&first.at).map(|(i, at)| (*at, i)).collect()
        } else {
            BTreeMap::new()
        };
        for node in known..count {
            if topology.is_pinned(node as u32) {
                continue;
            }
            for (at, weight) in ties_of(coordinates(topology, node as u32)) {
                if let Some(&point) = index.get(&at) {
                    self.parents[node].push((point, weight));
                    first.children[point as usize].push((node as u32, weight));
                }
            }
        }
        let mut points: Vec<u32> = touched
            .iter()
            .copied()
            .chain(known as u32..count as u32)
            .filter_map(|n| self.parents.get(n as usize))
            .flat_map(|t| t.iter())
            .map(|t| t.0)
            .collect();
        for l in 0..self.levels.len() {
            let level = &self.levels[l];
            let own = points.clone();
            for point in own {
                points.extend(level.around[point as usize]);
            }
            points.retain(|&p| (p as usize) < level.at.len());
            points.sort_unstable();
            points.dedup();
            self.assemble(topology, l, &points);
            let level = &self.levels[l];
            points = points
                .iter()
                .filter_map(|&p| level.parents.get(p as usize))
                .flat_map(|t| t.iter())
                .map(|t| t.0)
                .collect();
        }
    }

    /// Computes the rows of these points of level `l`.
    fn assemble(&mut self, topology: &Topology, l: usize, points: &[u32]) {
        let rows: Vec<[Block; 27]> = points
            .par_iter()
            .map(|&p| {
                if l == 0 {
                    self.row_over_springs(topology, p)
                } else {
                    self.row_over_level(l, p)
                }
            })
            .collect();
        let level = &mut self.levels[l];
        for (&point, row) in points.iter().zip(&rows) {
            level.inverse[point as usize] = inverse(&row[13]);
            level.own[point as usize] = (row[13][0][0] + row[13][1][1] + row[13][2][2]) / 3.0;
            level.rows[point as usize] = *row;
        }
    }

    fn row_over_springs(&self, topology: &Topology, point: u32) -> [Block; 27] {
        let level = &self.levels[0];
        let own = level.at[point as usize];
        let per_spacing = (1.0 / topology.model().spacing_m) as f32;
        let mut row = [EMPTY; 27];
        for &(i, wi) in &level.children[point as usize] {
            for spring in topology.springs().row(i) {
                let j = spring.to;
                let far = &self.parents[j as usize];
                let wj = far.iter().find(|t| t.0 == point).map_or(0.0, |t| t.1);
                if wj > 0.0 && j < i {
                    continue;
                }
                let part = wi - wj;
                if part == 0.0 {
                    continue;
                }
                let d: Vec3 = topology.rest(j) - topology.rest(i);
                let length = d.norm().max(f64::MIN_POSITIVE);
                let n: [f32; 3] = std::array::from_fn(|a| (d[a] / length) as f32);
                let floor = sideways(spring.rest_length, per_spacing);
                let mut block = outer(n, spring.stiffness * part * (1.0 - floor));
                for (a, column) in block.iter_mut().enumerate() {
                    column[a] += spring.stiffness * part * floor;
                }
                for &(other, w) in self.parents[i as usize].iter() {
                    if let Some(s) = slot(own, level.at[other as usize]) {
                        add_scaled(&mut row[s], &block, w);
                    }
                }
                for &(other, w) in far.iter() {
                    if let Some(s) = slot(own, level.at[other as usize]) {
                        add_scaled(&mut row[s], &block, -w);
                    }
                }
            }
        }
        row
    }

    fn row_over_level(&self, l: usize, point: u32) -> [Block; 27] {
        let (finer, level) = (&self.levels[l - 1], &self.levels[l]);
        let own = level.at[point as usize];
        let mut row = [EMPTY; 27];
        for &(i, wi) in &level.children[point as usize] {
            for (j, block) in finer.around[i as usize].iter().zip(&finer.rows[i as usize]) {
                for &(other, w) in finer
                    .parents
                    .get(*j as usize)
                    .into_iter()
                    .flat_map(|t| t.iter())
                {
                    if let Some(s) = slot(own, level.at[other as usize]) {
                        add_scaled(&mut row[s], block, wi * w);
                    }
                }
            }
        }
        row
    }
}

impl Level {
    /// The lattice of half the density over `fine`, and the ties of its points.
    fn over(fine: &[[i32; 3]], free: impl Fn(usize) -> bool) -> (Self, Vec<Ties>) {
        let mut index: BTreeMap<[i32; 3], u32> = BTreeMap::new();
        for (i, at) in fine.iter().enumerate() {
            if free(i) {
                for (parent, _) in ties_of(*at) {
                    index.insert([parent[2], parent[1], parent[0]], 0);
                }
            }
        }
        let mut at = Vec::with_capacity(index.len());
        for (i, (key, value)) in index.iter_mut().enumerate() {
            *value = i as u32;
            at.push([key[2], key[1], key[0]]);
        }
        let find = |p: [i32; 3]| index.get(&[p[2], p[1], p[0]]).copied();
        let count = at.len();
        let mut children = vec![Vec::new(); count];
        let mut ties = vec![Ties::default(); fine.len()];
        for (i, own) in fine.iter().enumerate() {
            if free(i) {
                for (parent, weight) in ties_of(*own) {
                    if let Some(p) = find(parent) {
                        ties[i].push((p, weight));
                        children[p as usize].push((i as u32, weight));
                    }
                }
            }
        }
        let around = at
            .iter()
            .map(|p| {
                std::array::from_fn(|s| {
                    let s = s as i32;
                    let step = [s % 3 - 1, s / 3 % 3 - 1, s / 9 - 1];
                    find(std::array::from_fn(|a| p[a] + step[a])).unwrap_or(count as u32)
                })
            })
            .collect();
        let list = || {
            let mut list = List::default();
            list.grow(count);
            list
        };
        let level = Self {
            at,
            around,
            rows: vec![[EMPTY; 27]; count],
            inverse: vec![EMPTY; count],
            own: vec![0.0; count],
            children,
            parents: Vec::new(),
            e: vec![ZERO; count + 1],
            rhs: vec![ZERO; count],
            live: list(),
            loaded: list(),
            smoothed: list(),
            ring: list(),
            extra_of: vec![NONE; count],
            extra: Vec::new(),
        };
        (level, ties)
    }
}
