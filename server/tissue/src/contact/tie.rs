//! Ties of points in the tissue to a needle.

use crate::Vec3;

/// Nodes that share a force, in a group of three as those of a sample.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Spread {
    pub(crate) nodes: [u32; 3],
    pub(crate) weights: [f64; 3],
}

/// A spring of a point along one direction that yields at its limits.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tie {
    /// A unit vector.
    pub(super) direction: Vec3,
    /// Coordinate of the point along the direction without a force, m.
    pub(super) target: f64,
    /// In N/m.
    pub(super) stiffness: f64,
    /// Least and greatest force on the point, N.
    pub(super) limits: [f64; 2],
}

impl Tie {
    /// Force on a point whose coordinate is `beyond` m past the target, in N, and the stiffness there: zero where it yields.
    #[inline]
    pub(super) fn force(&self, beyond: f64) -> (f64, f64) {
        let [least, greatest] = self.limits;
        let spring = -self.stiffness * beyond;
        if spring <= least {
            (least, 0.0)
        } else if spring >= greatest {
            (greatest, 0.0)
        } else {
            (spring, self.stiffness)
        }
    }
}

/// A point in the tissue with its ties to a tool.
#[derive(Debug, Clone, Copy)]
pub(super) struct Held {
    /// Its eight nodes; the last one twice, with its weight once.
    pub(super) spreads: [Spread; 3],
    /// Position at rest.
    rest: Vec3,
    pub(super) proxy: u32,
    pub(super) ties: [Tie; 3],
}

impl Held {
    pub(super) fn new(
        nodes: [u32; 8],
        weights: [f64; 8],
        rest: Vec3,
        proxy: u32,
        ties: [Tie; 3],
    ) -> Self {
        let spread = |k: usize| Spread {
            nodes: std::array::from_fn(|i| nodes[(3 * k + i).min(7)]),
            weights: std::array::from_fn(|i| weights.get(3 * k + i).copied().unwrap_or(0.0)),
        };
        Self {
            spreads: [0, 1, 2].map(spread),
            rest,
            proxy,
            ties,
        }
    }

    /// The sum of a vector per node.
    #[inline]
    pub(super) fn sum(&self, of: impl Fn(u32) -> Vec3) -> Vec3 {
        let mut sum = Vec3::zeros();
        for spread in &self.spreads {
            for (&node, w) in spread.nodes.iter().zip(spread.weights) {
                sum += of(node) * w;
            }
        }
        sum
    }

    /// Current position.
    #[inline]
    pub(super) fn position(&self, u: &[Vec3]) -> Vec3 {
        self.rest + self.sum(|n| u[n as usize])
    }

    /// Each tie with its force on the point, N, and its stiffness there.
    #[inline]
    pub(super) fn forces(&self, u: &[Vec3]) -> impl Iterator<Item = (&Tie, f64, f64)> {
        let x = self.position(u);
        let tied = self.ties.iter().filter(|tie| tie.stiffness > 0.0);
        tied.map(move |tie| {
            let (force, stiffness) = tie.force(tie.direction.dot(&x) - tie.target);
            (tie, force, stiffness)
        })
    }

    /// Force on the point, N.
    pub(super) fn force(&self, u: &[Vec3]) -> Vec3 {
        let of = |(tie, force, _): (&Tie, f64, f64)| tie.direction * force;
        self.forces(u).map(of).sum()
    }
}
