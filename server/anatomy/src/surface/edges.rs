//! The edges of a surface and the triangles that use each.

use palpate_tissue::Vec3;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct EdgeUse {
    /// Smaller vertex.
    pub(crate) low: u32,
    /// Larger vertex.
    pub(crate) high: u32,
    pub(crate) triangle: u32,
    /// Whether the triangle runs from `low` to `high`.
    pub(crate) forward: bool,
}

/// All uses of all edges, sorted: the uses of one edge are adjacent.
pub(crate) struct Edges(Vec<EdgeUse>);

impl Edges {
    /// The edges of triangles whose three corners differ.
    pub(crate) fn of(triangles: &[[u32; 3]]) -> Self {
        let mut uses: Vec<EdgeUse> = triangles
            .iter()
            .enumerate()
            .flat_map(|(t, &[a, b, c])| {
                [(a, b), (b, c), (c, a)].map(|(from, to)| EdgeUse {
                    low: from.min(to),
                    high: from.max(to),
                    triangle: t as u32,
                    forward: from < to,
                })
            })
            .collect();
        uses.sort_unstable();
        Self(uses)
    }

    pub(crate) fn each(&self) -> impl Iterator<Item = &[EdgeUse]> {
        self.0.chunk_by(|a, b| (a.low, a.high) == (b.low, b.high))
    }
}

/// Disjoint sets of small integers (union-find).
pub(crate) struct Sets(Vec<u32>);

impl Sets {
    /// `n` sets of one each.
    pub(crate) fn new(n: usize) -> Self {
        Self((0..n as u32).collect())
    }

    /// The smallest member of the set that contains `i`.
    pub(crate) fn find(&mut self, mut i: u32) -> u32 {
        while self.0[i as usize] != i {
            self.0[i as usize] = self.0[self.0[i as usize] as usize];
            i = self.0[i as usize];
        }
        i
    }

    /// Merges two sets; the smaller representative stays. Returns whether they were different sets.
    pub(crate) fn join(&mut self, a: u32, b: u32) -> bool {
        let (a, b) = (self.find(a), self.find(b));
        self.0[a.max(b) as usize] = a.min(b);
        a != b
    }
}

/// Number of faults of a kind, and the place of the first one.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Tally {
    pub(crate) count: usize,
    pub(crate) first: Option<Vec3>,
}

impl Tally {
    /// Counts places of faults.
    pub(crate) fn of(places: impl IntoIterator<Item = Vec3>) -> Self {
        let mut places = places.into_iter();
        let first = places.next();
        let count = usize::from(first.is_some()) + places.count();
        Self { count, first }
    }
}

/// Text of a point, for messages.
pub(crate) fn in_mm(p: &Vec3) -> String {
    format!("({:.1}, {:.1}, {:.1}) mm", p.x * 1e3, p.y * 1e3, p.z * 1e3)
}

/// Text of a size, for messages.
pub(crate) fn size_in_mm(extent: &Vec3) -> String {
    format!(
        "{:.3} x {:.3} x {:.3} mm",
        extent.x * 1e3,
        extent.y * 1e3,
        extent.z * 1e3
    )
}
