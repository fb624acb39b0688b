//! Contact model of the force loop, from the solver's reaction on the tool.

use palpate_haptics::{CONTACTS_MAX, ContactModel, MINDLIN, Touch};
use palpate_protocol::ClientTime;
use palpate_tissue::{ContactPatch, Reaction, Vec3};

/// Validity radius of the contact model, m: 0.5 m/s for 16 ms, four periods of the solver. A smaller radius fades the
/// force in fast strokes; a larger one extrapolates a linear law too far.
pub(crate) const MODEL_RADIUS_M: f64 = 8e-3;

/// Ratio of contact damping to normal stiffness, s. 1 ms suppresses oscillation of a hand against tissue and is not
/// perceptible.
pub(super) const DAMPING_S: f64 = 1e-3;

/// Maximum total damping of all contacts, N·s/m: well below the stability limit 2 m / T = 200 of a 0.1 kg handle at 1
/// kHz.
pub(super) const DAMPING_MAX_NS_PER_M: f64 = 2.0;

/// Contact model of a tool with these parts, which share its pivot. The linear law is centred where the solver
/// computed the forces: at the proxy. Where the tissue has yet to yield to the tool, as bone never does, the law also
/// holds at the tool.
pub(crate) fn contact_model(
    now: ClientTime,
    topology_version: u32,
    parts: &[&Reaction],
) -> ContactModel {
    let free = ContactModel::free_at(now, topology_version);
    let Some(first) = parts.iter().find(|r| r.contacts > 0) else {
        return free;
    };
    let lag_m = parts.iter().map(|r| r.lag_m).fold(0.0, f64::max);
    let mut model = ContactModel {
        x0: first.at,
        turn0: first.turn,
        radius: MODEL_RADIUS_M + lag_m,
        ..free
    };
    // The contact points of a tool of two parts: the first half belongs to the first part.
    let of_part = CONTACTS_MAX / parts.len().clamp(1, CONTACTS_MAX);
    let mut torque = Vec3::zeros();
    let pressing = parts.iter().filter(|r| r.contacts > 0).count().max(1) as f64;
    for (part, reaction) in parts.iter().enumerate() {
        let from_pivot = reaction.at - first.at;
        torque += reaction.torque + from_pivot.cross(&reaction.force);
        let pressed: f64 = reaction.contact_patches.iter().map(|p| p.pressed).sum();
        for place in &reaction.contact_patches {
            let at = usize::from(place.number) * of_part / CONTACTS_MAX;
            let slot = &mut model.touches[part * of_part + at];
            let mut new = touch(reaction, place, place.pressed / pressed, from_pivot);
            new.damping /= pressing;
            *slot = if slot.touches { both(slot, &new) } else { new };
        }
    }
    for touch in model.touching() {
        torque -= touch.lever.cross(&touch.f0);
    }
    model.couple = torque;
    model
}

/// Ratio of tangent to secant stiffness F / δ of a contact, with δ the pressure-weighted mean indentation: the value
/// of a sphere on an elastic half-space (Hertz 1882). A contact of constant area has 1.
const TANGENT_OF_SECANT: f64 = 1.2;

/// The contact point that carries `share` of the total pressure.
fn touch(reaction: &Reaction, place: &ContactPatch, share: f64, from_pivot: Vec3) -> Touch {
    let stiffness = reaction.stiffness * share;
    let along = place.normal.dot(&(stiffness * place.normal)).max(0.0);
    Touch {
        touches: true,
        lever: place.lever + from_pivot,
        f0: place.force,
        stiffness,
        tangential_stiffness: MINDLIN * TANGENT_OF_SECANT * place.pressed / place.indentation_m,
        damping: (DAMPING_S * along).min(DAMPING_MAX_NS_PER_M * share),
        normal: place.normal,
        pressed_n: place.pressed,
        mu_static: place.friction_static,
        mu_dynamic: place.friction_dynamic.min(place.friction_static),
    }
}

/// Merges two contact points into one.
fn both(a: &Touch, b: &Touch) -> Touch {
    let sum = a.pressed_n + b.pressed_n;
    let [p, q] = [a.pressed_n / sum, b.pressed_n / sum];
    let f0 = a.f0 + b.f0;
    Touch {
        touches: true,
        lever: a.lever * p + b.lever * q,
        f0,
        stiffness: a.stiffness + b.stiffness,
        tangential_stiffness: a.tangential_stiffness + b.tangential_stiffness,
        damping: a.damping + b.damping,
        normal: f0.try_normalize(0.1 * sum).unwrap_or(a.normal),
        pressed_n: sum.max(f0.norm()),
        mu_static: a.mu_static * p + b.mu_static * q,
        mu_dynamic: a.mu_dynamic * p + b.mu_dynamic * q,
    }
}

/// A model that the force loop rejects.
pub(crate) fn unusable(free: &ContactModel) -> ContactModel {
    ContactModel {
        couple: Vec3::repeat(f64::NAN),
        ..*free
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, UnitQuaternion};
    use proptest::prelude::*;

    use super::*;

    fn patch_at(number: u8, lever: Vec3, force: Vec3) -> ContactPatch {
        ContactPatch {
            number,
            lever,
            force,
            normal: force.normalize(),
            pressed: force.norm() * 1.1,
            indentation_m: 2e-3,
            friction_static: 0.5,
            friction_dynamic: 0.3,
        }
    }

    fn reaction(contact_patches: Vec<ContactPatch>) -> Reaction {
        let force: Vec3 = contact_patches.iter().map(|p| p.force).sum();
        Reaction {
            tool: 2,
            force,
            torque: contact_patches
                .iter()
                .map(|p| p.lever.cross(&p.force))
                .sum::<Vec3>()
                + Vec3::new(1e-3, 0.0, 2e-3),
            stiffness: Matrix3::from_diagonal_element(400.0),
            normal: force.normalize(),
            contacts: 5,
            friction_static: 0.5,
            friction_dynamic: 0.3,
            force_error: 0.0,
            at: Vec3::new(0.1, 0.2, 0.3),
            lag_m: 0.0,
            turn: UnitQuaternion::from_euler_angles(0.1, 0.2, 0.3),
            contact_patches,
            shaft: None,
            is_inserted: false,
        }
    }

    proptest! {
        /// Force, torque and stiffness of the solver are preserved for any number of parts.
        #[test]
        fn contact_model_preserves_force_torque_and_stiffness(
            parts in proptest::collection::vec(
                proptest::collection::vec((prop::array::uniform3(-0.05..0.05f64), prop::array::uniform3(0.1..2.0f64)), 1..16),
                1..3,
            ),
        ) {
            let parts: Vec<Reaction> = parts
                .into_iter()
                .map(|contact_patches| {
                    let numbered = contact_patches.into_iter().enumerate();
                    reaction(numbered.map(|(n, (l, f))| patch_at(n as u8, l.into(), f.into())).collect())
                })
                .collect();
            let of: Vec<&Reaction> = parts.iter().collect();
            let model = contact_model(ClientTime::from_micros(7), 3, &of);
            prop_assert!(model.is_usable() && model.in_contact());
            let force: Vec3 = parts.iter().map(|r| r.force).sum();
            let torque: Vec3 = parts.iter().map(|r| r.torque).sum();
            prop_assert!((model.force() - force).norm() < 1e-9);
            prop_assert!((model.torque() - torque).norm() < 1e-9);
            let stiffness: Matrix3<f64> = model.touching().map(|t| t.stiffness).sum();
            let expected = Matrix3::from_diagonal_element(400.0 * parts.len() as f64);
            prop_assert!((stiffness - expected).norm() < 1e-6);
            prop_assert!(model.touching().map(|t| t.damping).sum::<f64>() <= 2.0 + 1e-9);
        }
    }

    #[test]
    fn tangential_stiffness_follows_from_indentation_alone() {
        let learned = |k: f64| Reaction {
            stiffness: Matrix3::from_diagonal_element(k),
            ..reaction(vec![patch_at(0, Vec3::zeros(), Vec3::z() * 0.2)])
        };
        let tie =
            |r: &Reaction| contact_model(ClientTime::ZERO, 1, &[r]).touches[0].tangential_stiffness;
        // 0.22 N at an indentation of 2 mm.
        assert!((tie(&learned(30.0)) - 88.0).abs() < 1e-9);
        assert_eq!(tie(&learned(30.0)), tie(&learned(60.0)));
    }

    #[test]
    fn tool_without_contact_is_free() {
        let nothing = Reaction {
            contacts: 0,
            ..reaction(vec![patch_at(0, Vec3::zeros(), Vec3::z())])
        };
        let model = contact_model(ClientTime::ZERO, 1, &[&nothing]);
        assert!(!model.in_contact() && model.is_usable());
        assert!(!contact_model(ClientTime::ZERO, 1, &[]).in_contact());
        assert!(!unusable(&ContactModel::FREE).is_usable());
    }
}
