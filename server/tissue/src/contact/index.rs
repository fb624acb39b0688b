//! Where to look for surface triangles: a grid over their rest positions.
//!
//! Rest positions do not change when tissue is pressed, so the grid is built once and extended by
//! cuts. A search widens its reach by the largest displacement there is.

use crate::{Topology, Vec3};

/// Bins at most: 4 million list heads; a larger model gets larger bins.
const BINS_MAX: f64 = 4.0e6;

pub(crate) struct SurfaceIndex {
    low: Vec3,
    size: f64,
    counts: [usize; 3],
    bins: Vec<Vec<u32>>,
    known: usize,
    /// Largest distance in m from a triangle's middle to its corners.
    extent: f64,
}

impl SurfaceIndex {
    pub(crate) fn new(topology: &Topology) -> Self {
        let (mut low, mut high) = (Vec3::repeat(f64::MAX), Vec3::repeat(f64::MIN));
        for node in 0..topology.node_count() as u32 {
            low = low.inf(&topology.rest(node));
            high = high.sup(&topology.rest(node));
        }
        let span = (high - low).sup(&Vec3::zeros());
        let spacing = topology.model().spacing_m;
        let mut size = 2.0 * spacing.max(1e-9);
        let bins = |size: f64| {
            span.iter()
                .map(|s| (s / size).floor() + 1.0)
                .product::<f64>()
        };
        while bins(size) > BINS_MAX {
            size *= 1.5;
        }
        let counts = [0, 1, 2].map(|a| (span[a] / size).floor() as usize + 1);
        let mut index = Self {
            low,
            size,
            counts,
            bins: vec![Vec::new(); counts.iter().product()],
            known: 0,
            extent: 0.0,
        };
        index.follow(topology);
        index
    }

    /// Takes in triangles that cuts appended; starts over if the surface was rebuilt shorter.
    pub(crate) fn follow(&mut self, topology: &Topology) {
        let triangles = &topology.boundary().triangles;
        if triangles.len() < self.known {
            self.bins.iter_mut().for_each(Vec::clear);
            self.known = 0;
        }
        for (i, nodes) in triangles.iter().enumerate().skip(self.known) {
            let corners = nodes.map(|n| topology.rest(n));
            let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
            for corner in corners {
                self.extent = self.extent.max((corner - middle).norm());
            }
            let [x, y, z] = [0, 1, 2].map(|a| self.bin(middle[a], a));
            self.bins[x + self.counts[0] * (y + self.counts[1] * z)].push(i as u32);
        }
        self.known = triangles.len();
    }

    fn bin(&self, value: f64, axis: usize) -> usize {
        let b = ((value - self.low[axis]) / self.size).floor();
        b.clamp(0.0, (self.counts[axis] - 1) as f64) as usize
    }

    /// Calls `visit` with every triangle that may have a part within `reach` of `centre` at rest.
    pub(crate) fn near(&self, centre: Vec3, reach: f64, mut visit: impl FnMut(u32)) {
        let reach = reach + self.extent;
        let from = [0, 1, 2].map(|a| self.bin(centre[a] - reach, a));
        let to = [0, 1, 2].map(|a| self.bin(centre[a] + reach, a));
        for z in from[2]..=to[2] {
            for y in from[1]..=to[1] {
                for x in from[0]..=to[0] {
                    let bin = x + self.counts[0] * (y + self.counts[1] * z);
                    self.bins[bin].iter().for_each(|&t| visit(t));
                }
            }
        }
    }

    /// A reach that covers the whole surface from anywhere near it.
    pub(crate) fn span(&self) -> f64 {
        self.counts.iter().sum::<usize>() as f64 * self.size
    }
}
