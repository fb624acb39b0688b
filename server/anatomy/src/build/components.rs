//! The connected components of the input, and how much of each the model keeps.

use palpate_tissue::Vec3;

use super::parts::ClosedParts;
use super::rays::{Hits, Rays};
use super::small_parts::SmallPart;
use super::strands::{NO_WALL, Strands, WallEnds};

/// A piece of a component: all of it, unless necks thinner than the distance of rays join several pieces.
#[derive(Debug, Clone, Copy)]
pub(super) struct Piece {
    pub(super) region: u8,
    /// Volume in m³.
    pub(super) volume: f64,
    /// Part of the volume that the model's region has in common with it.
    pub(super) kept: f64,
    /// A point inside, the middle of its longest stretch.
    pub(super) at: Vec3,
    /// The component of the model's region that has most of it.
    pub(super) within: Option<u32>,
}

/// A connected component of a region of the input, less what later regions take.
#[derive(Debug, Clone)]
pub(super) struct Component {
    /// The component as a whole; it lies at the largest of its pieces, and within the component of the model that has
    /// most of one.
    pub(super) whole: Piece,
    /// Its pieces, if it has several.
    pub(super) pieces: Vec<Piece>,
}

impl From<Piece> for Component {
    fn from(whole: Piece) -> Self {
        Self {
            whole,
            pieces: Vec::new(),
        }
    }
}

impl Component {
    fn of(pieces: Vec<Piece>) -> Self {
        let sum = |of: &dyn Fn(&Piece) -> f64| pieces.iter().map(of).sum::<f64>();
        let most = |of: &dyn Fn(&Piece) -> f64| {
            // At equal volumes the first one, as everywhere.
            let pieces = pieces.iter().rev();
            pieces.max_by(|a, b| of(a).total_cmp(&of(b))).copied()
        };
        let kept = |p: &Piece| p.volume * p.kept;
        let volume = sum(&|p| p.volume);
        let largest = most(&|p| p.volume).expect("a component has a piece");
        let whole = Piece {
            volume,
            kept: sum(&kept) / volume,
            within: most(&kept).and_then(|p| p.within),
            ..largest
        };
        let several = pieces.len() > 1;
        Self {
            whole,
            pieces: if several { pieces } else { Vec::new() },
        }
    }
}

/// Length of rays in a component of the input: of all, or of those in a component of the same region of the model.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shared {
    pub(super) input: u32,
    pub(super) model: Option<u32>,
    pub(super) length: f64,
}

/// Sorts by components and adds up the lengths of equal pairs.
pub(super) fn merge(shared: &mut Vec<Shared>) {
    // A stable sort: the sums have one order.
    shared.sort_by_key(|s| (s.input, s.model));
    shared.dedup_by(|next, kept| {
        let same = (next.input, next.model) == (kept.input, kept.model);
        if same {
            kept.length += next.length;
        }
        same
    });
}

/// The components that strands belong to, in the order of their first strands. `point` places a depth of a row of strands
/// in the world, and `unit` is the volume of a unit of length.
pub(super) fn components(
    strands: &Strands,
    shared: &[Shared],
    known: &KnownParts,
    point: impl Fn([usize; 2], f64) -> Vec3,
    unit: f64,
) -> Vec<Component> {
    const NONE: u32 = u32::MAX;
    let mut slots = vec![NONE; strands.len()];
    let mut pieces: Vec<Piece> = Vec::new();
    let mut longest: Vec<f64> = Vec::new();
    let mut component_of: Vec<u32> = Vec::new();
    let is_skipped = |part: u32| known.replaced.binary_search(&part).is_ok();
    let [width, height] = strands.size();
    for (v, u) in (0..height).flat_map(|v| (0..width).map(move |u| (v, u))) {
        for (strand, part) in strands.of([u, v]).filter(|s| !is_skipped(s.1)) {
            let slot = &mut slots[part as usize];
            if *slot == NONE {
                *slot = pieces.len() as u32;
                longest.push(0.0);
                component_of.push(known.component(part));
                pieces.push(Piece {
                    region: strand.region,
                    volume: 0.0,
                    kept: 0.0,
                    at: Vec3::zeros(),
                    within: None,
                });
            }
            let (own, longest) = (&mut pieces[*slot as usize], &mut longest[*slot as usize]);
            let length = strand.to - strand.from;
            own.volume += length * unit;
            if length > *longest {
                *longest = length;
                own.at = point([u, v], f64::midpoint(strand.from, strand.to));
            }
        }
    }
    let same = shared.chunk_by(|a, b| a.input == b.input);
    for same in same.filter(|s| !is_skipped(s[0].input)) {
        let own = &mut pieces[slots[same[0].input as usize] as usize];
        let sum = |common: bool| -> f64 {
            let lengths = same.iter().filter(|s| s.model.is_some() == common);
            // The sum of no numbers would be -0.
            lengths.fold(0.0, |sum, s| sum + s.length)
        };
        own.kept = sum(true) / sum(false);
        // At equal volumes the first one, so that the result does not depend on the order of rows.
        let common = same.iter().rev().filter(|s| s.model.is_some());
        let most = common.max_by(|a, b| a.length.total_cmp(&b.length));
        own.within = most.and_then(|s| s.model);
    }
    let mut order: Vec<usize> = (0..pieces.len()).collect();
    // Components have the number of their first strand.
    order.sort_by_key(|p| component_of[*p]);
    let same = order.chunk_by(|a, b| component_of[*a] == component_of[*b]);
    same.map(|same| Component::of(same.iter().map(|p| pieces[*p]).collect()))
        .collect()
}

/// What closed parts tell of strands.
#[derive(Default)]
pub(super) struct KnownParts {
    /// The component of each strand; without elements each part of the strands is one.
    component_of: Vec<u32>,
    /// The parts of strands that consist of small closed parts only, sorted.
    replaced: Vec<u32>,
}

impl KnownParts {
    fn component(&self, part: u32) -> u32 {
        self.component_of
            .get(part as usize)
            .copied()
            .unwrap_or(part)
    }
}

/// The closed parts of all surfaces, numbered in one sequence, as the walls that strands end on.
pub(super) struct PartWalls {
    /// Number of the first part of each surface, and one past the last of all.
    first: Vec<u32>,
    /// Hits of each part.
    hits: Vec<u32>,
    ends: WallEnds,
}

impl PartWalls {
    /// Finds the part that each strand ends on. A part is whole when all of its hits are such ends.
    pub(super) fn of(strands: &Strands, hits: &[Hits], rays: &Rays, parts: &[ClosedParts]) -> Self {
        let mut first = vec![0];
        for parts in parts {
            first.push(first[first.len() - 1] + parts.boxes.len() as u32);
        }
        let walls = first[first.len() - 1] as usize;
        let (mut hit, mut ended) = (vec![0; walls], vec![0; walls]);
        let mut of = vec![[NO_WALL; 2]; strands.len()];
        let [width, height] = rays.count;
        for (v, u) in (0..height).flat_map(|v| (0..width).map(move |u| (v, u))) {
            let ray = rays.index([u, v]);
            for (region, hits) in hits.iter().enumerate() {
                let own = strands.range(ray);
                let mut own = own.filter(|s| usize::from(strands.strand(*s).0.region) == region);
                let mut next = own.next();
                for at in hits.of(ray) {
                    let part = parts[region].of_triangle[at.triangle as usize];
                    let wall = first[region] + part;
                    hit[wall as usize] += 1;
                    // Strands keep the depths of hits unchanged.
                    while let Some(strand) = next {
                        let (stretch, _) = strands.strand(strand);
                        let ends = [stretch.from, stretch.to];
                        if let Some(end) = ends.iter().position(|end| *end == at.depth) {
                            ended[wall as usize] += 1;
                            of[strand][end] = wall;
                        }
                        if stretch.to > at.depth {
                            break;
                        }
                        next = own.next();
                    }
                }
            }
        }
        let is_whole = hit.iter().zip(&ended).map(|(hit, ended)| hit == ended);
        let is_whole = is_whole.collect();
        Self {
            first,
            hits: hit,
            ends: WallEnds { of, is_whole },
        }
    }

    /// Hits of a part of a surface.
    pub(super) fn hits(&self, surface: usize, part: u32) -> u32 {
        self.hits[(self.first[surface] + part) as usize]
    }

    /// Connects the strands by their walls.
    pub(super) fn join(mut self, strands: &mut Strands, small: &[SmallPart]) -> KnownParts {
        let mut is_small = vec![false; self.hits.len()];
        for part in small {
            let wall = (self.first[usize::from(part.region)] + part.part) as usize;
            is_small[wall] = true;
            self.ends.is_whole[wall] = part.is_whole;
        }
        let component_of = strands.join_by_walls(&self.ends);
        let part = |strand: usize| strands.strand(strand).1;
        let mut others = vec![false; strands.len()];
        for (strand, walls) in self.ends.of.iter().enumerate() {
            let at_small = |wall: &u32| *wall != NO_WALL && is_small[*wall as usize];
            others[part(strand) as usize] |= !walls.iter().any(at_small);
        }
        let alone = (0..strands.len()).filter(|s| part(*s) as usize == *s && !others[*s]);
        KnownParts {
            replaced: alone.map(|s| s as u32).collect(),
            component_of,
        }
    }
}
