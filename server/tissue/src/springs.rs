//! Springs assembled per cell from its shear modulus.
//!
//! A cell has springs along its 12 edges (k1, structural), its 12 face diagonals (k2, shear) and its
//! four body diagonals (k3, shear). For the cubic lattice of spacing Δd, Σ k l² n n n n per volume is
//!
//! ```text
//! C11 = (k1 + 2 k2 + 4/3 k3)/Δd        C12 = C44 = (k2 + 4/3 k3)/Δd
//! ```
//!
//! so isotropy, C11 = 3 C44, needs k1 = k2 + 8/3 k3; then E = 2.5 C44 and Poisson's ratio is 1/4. With
//! k3 = k2/2 that is k1 = 0.56 E Δd, k2 = 0.24 E Δd, k3 = 0.12 E Δd.
//!
//! The seed (Lin 2007, fig. 3.2) has no body diagonals. They support nodes at a step of the lattice that lie
//! flat on an oblique surface. All edges and face diagonals of such a node lie in the surface. Without a spring
//! into the depth the node can be pushed through it with no force and stay there (measured: a press of 2 mm
//! left dents of 5 mm).
//!
//! An edge is shared by four cells and a face diagonal by two. Written per cell with its own volume V
//! and the spring's own length l, the stiffness is
//!
//! ```text
//! edge           0.14 E V / l²      (cube: V = Δd³, l = Δd      ->  k1/4)
//! face diagonal  0.24 E V / l²      (cube: V = Δd³, l = √2 Δd   ->  k2/2)
//! body diagonal  0.36 E V / l²      (cube: V = Δd³, l = √3 Δd   ->  k3)
//! ```
//!
//! which keeps the energy per volume of a uniform strain when a cell is scaled. Heterogeneity, boundaries and
//! the halves on both sides of a cut then need no special case. E stands for 2.5 μ: with the volume term
//! (`equilibrium/law.rs`) the springs carry the shear modulus alone, and at Poisson's ratio 1/4 that is Young's
//! modulus.
//!
//! The springs here ([`Topology::springs_of`](crate::Topology::springs_of)) have these shares regardless of the
//! shape of the cell. They are the springs of the seed's iteration (3.10), and the stiffness of a node is taken from
//! them. The equilibrium computes forces per cell,
//! with shares that make a distorted cell isotropic again (`fit.rs`).

/// One spring as seen from one of its ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spring {
    /// Node at the other end.
    pub to: u32,
    /// Stiffness k in N/m.
    pub stiffness: f32,
}

/// Share of Young's modulus that an edge spring carries; see the module docs.
pub(crate) const EDGE_SHARE: f64 = 0.14;
/// Share of Young's modulus that a face diagonal carries; see the module docs.
pub(crate) const DIAGONAL_SHARE: f64 = 0.24;
/// Share of Young's modulus that a body diagonal carries.
pub(crate) const BODY_SHARE: f64 = 0.36;
/// A spring shorter than this part of the spacing counts as this long when its stiffness is computed, so that
/// one bad corner cannot make the whole system stiff.
pub(crate) const LENGTH_FLOOR: f64 = 0.5;
