//! The length law (Lin 2007, eq. 3.4) on one node: its force and its tangent block.
//!
//! With `d0 = X_j - X_i` the spring at rest, `δ = u_j - u_i` and d = d0 + δ, the force on i is
//! k (|d| - l0) d/|d|. The difference of two nearly equal lengths would lose all digits of a small
//! strain, so it is written as
//!
//! ```text
//! q = |d|² - l0² = δ·(2 d0 + δ)          |d| - l0 = q / (|d| + l0)
//! ```
//!
//! which is exact in relative terms, zero at rest to the last bit, and lets the arithmetic run in
//! eight lanes of f32 on differences that were taken in f64.
//!
//! A spring does not know which way it points: under a deep press a node can pass its neighbour and
//! stay there, folded, in an equilibrium of its own. The seed's guard is the neighbouring bounding box
//! (eq. 3.7): a node stays between its neighbours along the axes of the rest state. As a force
//! (reconstructed), with p = d·d0 / l0², one at rest and negative when the ends have passed:
//!
//! ```text
//! guard on i = -G k (θ - p) d0     while p < θ
//! ```
//!
//! It is the gradient of a convex energy, so it adds no equilibria; with G θ > 1 it outweighs the spring
//! wherever that would hold a fold. It stays out of the way until a spring is pressed or turned to θ
//! of its length along d0, which a moderate press does nowhere; a flap turned by more than acos θ = 73°
//! against its rest state is held back by it.
//!
//! The tangent of one spring is k [n nᵀ + s (I - n nᵀ)] with s = 1 - l0/|d|. A compressed spring has
//! s < 0 and would make the block indefinite under a deep press, and a spring that is shorter than
//! what its ends move turns within one step, so that its tangent tells nothing of where it will pull.
//! So s is kept above a floor σ(l0/Δd) that is small for springs of the lattice's own length and one
//! for short ones: k I bounds the length law from above whatever the direction, and a larger block
//! only makes the step of a node shorter.

use crate::{SPRINGS_PER_NODE_MAX, Topology, Vec3};

const LANES: usize = 8;
const ROWS: usize = SPRINGS_PER_NODE_MAX / LANES;

/// Symmetric 3x3 block: xx, yy, zz, xy, xz, yz.
pub(crate) type Symmetric = [f64; 6];

/// θ: part of its rest length that a spring keeps along its rest direction before the guard pushes.
const GUARDED: f32 = 0.3;
/// G: stiffness of the guard in parts of the spring's; G θ must be above one.
const GUARD: f32 = 6.0;

/// Floor of s for springs as long as the lattice's own.
const SIDEWAYS: f32 = 0.1;
/// Length in spacings below which a spring counts as turning freely, and its floor is one.
const SHORT: f32 = 0.5;
/// Length in spacings from which on the floor is [`SIDEWAYS`].
const LONG: f32 = 0.9;

/// The floor σ of a spring of rest length `l0` on a lattice of spacing Δd, given as 1/Δd.
#[inline]
pub(crate) fn sideways(l0: f32, per_spacing: f32) -> f32 {
    let t = ((l0 * per_spacing - SHORT) / (LONG - SHORT)).clamp(0.0, 1.0);
    1.0 + t * (SIDEWAYS - 1.0)
}

/// The springs of one node, gathered into lanes.
pub(crate) struct Lanes {
    rest: [[[f32; LANES]; 3]; ROWS],
    relative: [[[f32; LANES]; 3]; ROWS],
    stiffness: [[f32; LANES]; ROWS],
    length: [[f32; LANES]; ROWS],
    used: usize,
    per_spacing: f32,
}

impl Lanes {
    /// Lanes for a lattice of this spacing in m.
    pub(crate) fn new(spacing: f64) -> Self {
        Self {
            per_spacing: (1.0 / spacing) as f32,
            rest: [[[0.0; LANES]; 3]; ROWS],
            relative: [[[0.0; LANES]; 3]; ROWS],
            stiffness: [[0.0; LANES]; ROWS],
            length: [[1.0; LANES]; ROWS],
            used: 0,
        }
    }

    /// Gathers the springs of `node` at the displacements `u`.
    #[inline]
    pub(crate) fn load(&mut self, topology: &Topology, u: &[Vec3], node: u32) {
        let rest = topology.rest(node);
        let own = u[node as usize];
        let row = topology.springs().row(node);
        let count = row.len().min(SPRINGS_PER_NODE_MAX);
        for (s, spring) in row[..count].iter().enumerate() {
            let (c, l) = (s / LANES, s % LANES);
            let d = topology.rest(spring.to) - rest;
            let v = u[spring.to as usize] - own;
            for a in 0..3 {
                self.rest[c][a][l] = d[a] as f32;
                self.relative[c][a][l] = v[a] as f32;
            }
            self.stiffness[c][l] = spring.stiffness;
            self.length[c][l] = spring.rest_length;
        }
        self.used = count.div_ceil(LANES);
        for s in count..self.used * LANES {
            let (c, l) = (s / LANES, s % LANES);
            for a in 0..3 {
                self.rest[c][a][l] = 1.0;
                self.relative[c][a][l] = 0.0;
            }
            self.stiffness[c][l] = 0.0;
            self.length[c][l] = 1.0;
        }
    }

    /// Force of the springs on the node in N.
    #[inline]
    pub(crate) fn force(&self) -> Vec3 {
        let mut sum = [[0.0f32; LANES]; 3];
        for c in 0..self.used {
            let [dx, dy, dz] = &self.rest[c];
            let [vx, vy, vz] = &self.relative[c];
            let (k, l0) = (&self.stiffness[c], &self.length[c]);
            for l in 0..LANES {
                let (x, y, z) = (dx[l] + vx[l], dy[l] + vy[l], dz[l] + vz[l]);
                let q = vx[l] * (dx[l] + x) + vy[l] * (dy[l] + y) + vz[l] * (dz[l] + z);
                let length = (x * x + y * y + z * z).sqrt().max(f32::MIN_POSITIVE);
                let t = k[l] * q / ((length + l0[l]) * length);
                let along = (x * dx[l] + y * dy[l] + z * dz[l]) / (l0[l] * l0[l]);
                let guard = GUARD * k[l] * (GUARDED - along).max(0.0);
                sum[0][l] += t * x - guard * dx[l];
                sum[1][l] += t * y - guard * dy[l];
                sum[2][l] += t * z - guard * dz[l];
            }
        }
        Vec3::new(fold(&sum[0]), fold(&sum[1]), fold(&sum[2]))
    }

    /// Tangent block of the node in N/m, positive definite.
    #[inline]
    pub(crate) fn tangent(&self) -> Symmetric {
        let mut sum = [[0.0f32; LANES]; 6];
        for c in 0..self.used {
            let [dx, dy, dz] = &self.rest[c];
            let [vx, vy, vz] = &self.relative[c];
            let (k, l0) = (&self.stiffness[c], &self.length[c]);
            for l in 0..LANES {
                let (x, y, z) = (dx[l] + vx[l], dy[l] + vy[l], dz[l] + vz[l]);
                let square = (x * x + y * y + z * z).max(f32::MIN_POSITIVE);
                let floor = sideways(l0[l], self.per_spacing);
                let s = (1.0 - l0[l] / square.sqrt()).max(floor);
                let along = k[l] * (1.0 - s) / square;
                let across = k[l] * s;
                let (a, b, c) = (dx[l], dy[l], dz[l]);
                let rest = l0[l] * l0[l];
                let guarded = x * a + y * b + z * c < GUARDED * rest;
                let guard = if guarded { GUARD * k[l] / rest } else { 0.0 };
                sum[0][l] += along * x * x + guard * a * a + across;
                sum[1][l] += along * y * y + guard * b * b + across;
                sum[2][l] += along * z * z + guard * c * c + across;
                sum[3][l] += along * x * y + guard * a * b;
                sum[4][l] += along * x * z + guard * a * c;
                sum[5][l] += along * y * z + guard * b * c;
            }
        }
        [0, 1, 2, 3, 4, 5].map(|e| fold(&sum[e]))
    }
}

#[inline]
fn fold(lanes: &[f32; LANES]) -> f64 {
    let [a, b, c, d, e, f, g, h] = lanes.map(f64::from);
    ((a + b) + (c + d)) + ((e + f) + (g + h))
}

/// Inverse of a symmetric block, kept away from singularity by a part of its trace.
pub(crate) fn invert(m: &Symmetric) -> Symmetric {
    let guard = 1e-5 * (m[0] + m[1] + m[2]) + f64::MIN_POSITIVE;
    let (a, b, c) = (m[0] + guard, m[1] + guard, m[2] + guard);
    let (d, e, f) = (m[3], m[4], m[5]);
    let (xx, xy, xz) = (b * c - f * f, e * f - d * c, d * f - b * e);
    let det = a * xx + d * xy + e * xz;
    let inverse = 1.0 / det;
    if !inverse.is_finite() || inverse <= 0.0 {
        let t = 3.0 / (a + b + c);
        let t = if t.is_finite() { t } else { 0.0 };
        return [t, t, t, 0.0, 0.0, 0.0];
    }
    [
        xx * inverse,
        (a * c - e * e) * inverse,
        (a * b - d * d) * inverse,
        xy * inverse,
        xz * inverse,
        (d * e - a * f) * inverse,
    ]
}

/// Product of a symmetric block and a vector.
#[inline]
pub(crate) fn apply(m: &Symmetric, v: &Vec3) -> Vec3 {
    Vec3::new(
        m[0] * v.x + m[3] * v.y + m[4] * v.z,
        m[3] * v.x + m[1] * v.y + m[5] * v.z,
        m[4] * v.x + m[5] * v.y + m[2] * v.z,
    )
}

/// Force of the length law on one node, for checks and for pinned or held nodes.
pub(crate) fn force_on(topology: &Topology, u: &[Vec3], node: u32) -> Vec3 {
    let mut lanes = Lanes::new(topology.model().spacing_m);
    lanes.load(topology, u, node);
    lanes.force()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inverse_undoes_the_block() {
        let m = [5.0, 3.0, 4.0, 1.0, -0.5, 0.7];
        let v = Vec3::new(0.3, -1.0, 2.0);
        let back = apply(&invert(&m), &apply(&m, &v));
        assert!((back - v).norm() < 1e-3, "{back}");
    }
}
