//! The proxy: the place beside the device where the tissue would not press the tool.
//!
//! The normal force N of a contact point falls with its stiffness k along its normal n, so it is zero on the contact
//! plane at the distance N / k from the device. The total normal force F leads there. Along its direction f the forces
//! balance at the distance
//!
//! ```text
//! t = |F| / Σ k_i (n_i · f)²        F = Σ N_i n_i = |F| f
//! ```
//!
//! the mean distance of the contact planes along f, weighted by their shares of the sum. A tool with one contact point reaches its
//! plane. The stiffness is that of the solver, without the limit of the virtual coupling; friction has no part in it.
//! The proxy and the device agree exactly when F is zero.

use nalgebra::Vector3;

use crate::CONTACTS_MAX;
use crate::blend::ActiveContact;

/// Contact planes of the tool at its present pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ContactPlanes {
    /// Normal and stiffness of each active contact point.
    planes: [(Vector3<f64>, f64); CONTACTS_MAX],
    /// F, N.
    force: Vector3<f64>,
    /// Validity of the contact laws, m.
    reach: f64,
}

impl ContactPlanes {
    pub(crate) const NONE: Self = Self {
        planes: [(Vector3::new(0.0, 0.0, 0.0), 0.0); CONTACTS_MAX],
        force: Vector3::new(0.0, 0.0, 0.0),
        reach: 0.0,
    };

    /// Adds the plane of a contact point.
    pub(crate) fn add(&mut self, contact: &ActiveContact) {
        let normal = contact.contact.normal;
        self.planes[contact.index] = (normal, contact.stiffness);
        self.force += normal * contact.normal_force;
        self.reach = self.reach.max(contact.reach);
    }

    /// From the device to the proxy, m, within the validity of the contact laws.
    pub(crate) fn proxy_offset(&self) -> Vector3<f64> {
        let newtons = self.force.norm();
        if newtons == 0.0 {
            return Vector3::zeros();
        }
        let along = self.force / newtons;
        let share =
            |(normal, stiffness): &(Vector3<f64>, f64)| stiffness * normal.dot(&along).powi(2);
        let stiffness: f64 = self.planes.iter().map(share).sum();
        along * (newtons / stiffness).min(self.reach)
    }
}
