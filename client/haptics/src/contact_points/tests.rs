//! Laws of several simultaneous contact points, without the limits of the chain.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use palpate_device::{DeviceCaps, Pose, Workspace, Wrench};
use palpate_protocol::{ClientTime, Span};
use proptest::prelude::*;

use super::ContactPoints;
use crate::blend::Blend;
use crate::energy::turned;
use crate::motion::Motion;
use crate::{CONTACTS_MAX, ContactModel, Coupling, FrictionConfig, StiffnessCap, Touch};

const MS: Span = Span::from_millis(1);
const MU: [f64; 2] = [0.5, 0.35];

/// Far above every stiffness here, so that slopes are the tissue's own.
fn coupling() -> Coupling {
    let caps = DeviceCaps {
        name: "test".to_owned(),
        dof_in: 6,
        dof_out: 6,
        workspace: Workspace {
            min: Vector3::repeat(-1.0),
            max: Vector3::repeat(1.0),
        },
        max_force_n: 20.0,
        continuous_force_n: 10.0,
        max_torque_nm: 1.0,
        max_stiffness_n_per_m: 1e6,
        rate_hz: 1000.0,
    };
    Coupling::of_wrenches(StiffnessCap::new(&caps, 1e3, MS), 0.05)
}

fn at(tick: i64) -> ClientTime {
    ClientTime::from_micros(1_000_000 + 1000 * tick)
}

/// A line of `n` stations over `length` (m) along x, pressed onto the plane z = 0 with `force` (N) in total, on
/// tissue of `k` N/m in total.
fn line(n: usize, length: f64, force: f64, k: f64) -> ContactModel {
    let mut model = ContactModel {
        radius: 1.0,
        ..ContactModel::FREE
    };
    for (i, touch) in model.touches[..n].iter_mut().enumerate() {
        let share = 1.0 / n as f64;
        let f0 = Vector3::z() * (force * share);
        *touch = Touch {
            lever: Vector3::x() * (length * ((i as f64 + 0.5) * share - 0.5)),
            mu_static: MU[0],
            mu_dynamic: MU[1],
            ..Touch::at_pivot(f0, Matrix3::from_diagonal_element(k * share), Vector3::z())
        };
    }
    model
}

/// A tool whose contact points have accepted `model` at the solved pose.
struct Tool {
    blend: Blend,
    contact_points: ContactPoints,
    tick: i64,
}

impl Tool {
    fn touched(model: &ContactModel) -> Self {
        let mut tool = Self {
            blend: Blend::new(coupling()),
            contact_points: ContactPoints::new(FrictionConfig::default()),
            tick: 0,
        };
        tool.take(model);
        tool.tick = 20;
        tool
    }

    fn take(&mut self, model: &ContactModel) {
        let model = ContactModel {
            solved_at: at(self.tick),
            ..*model
        };
        self.blend.take(&model, at(self.tick), &rest(&model.pose()));
    }

    fn tick(&mut self, motion: &Motion) -> Wrench {
        self.tick += 1;
        self.contact_points
            .tick(&self.blend, at(self.tick), MS, motion)
            .0
    }
}

fn rest(pose: &Pose) -> Motion {
    Motion {
        x: pose.position,
        turn: pose.orientation,
        v: Vector3::zeros(),
        w: Vector3::zeros(),
    }
}

/// A block of 0.2 kg on `n` stations of a slope whose angle grows slowly to tan α = `share` μs. Returns its
/// displacement after 4 s, m, and whether any station ever slipped.
fn block_on_slope(n: usize, share: f64) -> (f64, bool) {
    let (mass, g, dt) = (0.2, 9.81, 1e-3);
    let mut tool = Tool::touched(&line(n, 0.06, mass * g, 300.0));
    let (mut x, mut v, mut slipped) = (Vector3::zeros(), Vector3::<f64>::zeros(), false);
    for i in 0..4000 {
        let alpha = (share * MU[0]).atan() * (f64::from(i) / 2000.0).min(1.0);
        if i % 4 == 0 {
            let mut model = line(n, 0.06, mass * g * alpha.cos(), 300.0);
            for touch in &mut model.touches {
                touch.damping = 2.0 / n as f64;
            }
            tool.take(&ContactModel { x0: x, ..model });
        }
        let motion = Motion {
            v,
            ..rest(&Pose::at(x))
        };
        let push = tool.tick(&motion).force;
        let air = v * -3.0;
        v += (push + air + Vector3::x() * (mass * g * alpha.sin())) * (dt / mass);
        v.z = 0.0;
        x += v * dt;
        slipped |= tool.contact_points.grips().slips;
    }
    (x.norm(), slipped)
}

#[test]
fn a_line_sticks_below_the_static_angle_and_slips_above() {
    for n in [1, 8, 16] {
        let (moved, slipped) = block_on_slope(n, 0.95);
        assert!(
            // The tangential stiffness is two thirds of the normal one.
            !slipped && moved < MU[0] * 0.2 * 9.81 / 200.0,
            "{n}: {moved} m"
        );
        let (moved, slipped) = block_on_slope(n, 1.05);
        assert!(slipped && moved > 0.1, "{n}: {moved} m");
    }
}

#[test]
fn torque_of_a_line_is_force_times_offset_of_its_middle() {
    for n in [1, 4, 15, 16] {
        let centred = line(n, 0.04, 2.0, 400.0);
        let mut beside = centred;
        for touch in &mut beside.touches {
            touch.lever.x += 0.02;
        }
        // At the solved pose, and 3 mm deeper.
        for z in [0.0, -0.003] {
            let motion = rest(&Pose::at(Vector3::new(0.0, 0.0, z)));
            let felt = Tool::touched(&centred).tick(&motion);
            assert!((felt.force.z - (2.0 - 400.0 * z)).abs() < 1e-9);
            assert!(felt.torque.norm() < 1e-9, "{n} stations: {:?}", felt.torque);
            let felt = Tool::touched(&beside).tick(&motion);
            let expected = Vector3::new(0.0, -0.02 * felt.force.z, 0.0);
            let off = (felt.torque - expected).norm() / expected.norm();
            assert!(off < 0.01, "{n} stations: {:?}", felt.torque);
        }
    }
}

#[test]
fn a_tilted_line_has_a_restoring_torque() {
    // A foundation of k per length l turns a line back by k l²/12 per radian.
    let mut tool = Tool::touched(&line(16, 0.06, 4.0, 400.0));
    let tilted = Pose {
        orientation: UnitQuaternion::new(Vector3::new(0.0, 0.02, 0.0)),
        ..Pose::default()
    };
    let torque = tool.tick(&rest(&tilted)).torque;
    let expected = -400.0 * 0.06 * 0.06 / 12.0 * 0.02;
    assert!(
        (torque.y / expected - 1.0).abs() < 0.02,
        "{} of {expected} N·m",
        torque.y
    );
}

#[test]
fn friction_opposes_a_line_turning_in_place() {
    // So stiff that the ties are short against their levers.
    let mut tool = Tool::touched(&line(16, 0.06, 4.0, 16e3));
    let (mut felt, w) = (Wrench::ZERO, Vector3::new(0.0, 0.0, 1.0));
    for tick in 0..600 {
        let turn = UnitQuaternion::new(w * (1e-3 * f64::from(tick)));
        let pose = Pose {
            orientation: turn,
            ..Pose::default()
        };
        felt = tool.tick(&Motion { w, ..rest(&pose) });
    }
    // Sliding everywhere: μd N times the mean arm, a quarter of the length.
    let expected = -MU[1] * 4.0 * 0.06 / 4.0;
    assert!(
        (felt.torque.z / expected - 1.0).abs() < 0.01,
        "{} of {expected}",
        felt.torque.z
    );
    assert!(
        (felt.force - Vector3::z() * 4.0).norm() < 1e-6,
        "{:?}",
        felt.force
    );
}

#[test]
fn a_squeezed_needle_sticks_without_a_net_force() {
    // Ten stations along x, each squeezed by 0.3 N from two sides that cancel.
    let mut model = line(10, 0.05, 0.0, 1000.0);
    for touch in &mut model.touches[..10] {
        touch.pressed_n = 0.3;
    }
    let mut tool = Tool::touched(&model);
    let v = Vector3::new(0.02, 0.0, 0.0);
    let mut most = 0.0_f64;
    let mut last = Vector3::zeros();
    for tick in 0..500 {
        let pose = Pose::at(v * (1e-3 * f64::from(tick)));
        last = tool.tick(&Motion { v, ..rest(&pose) }).force;
        most = most.max(-last.x);
    }
    assert!(
        most > 0.9 * MU[0] * 3.0 && most <= MU[0] * 3.0,
        "{most} N to break loose"
    );
    assert!(
        (last.x + MU[1] * 3.0).abs() < 1e-9,
        "{last:?} while it slides"
    );
    // It is held from both sides.
    for z in [1e-3, -1e-3] {
        let mut tool = Tool::touched(&model);
        let aside = rest(&Pose::at(Vector3::new(0.0, 0.0, z)));
        let led = tool.tick(&aside).force.z;
        assert!((led + 1000.0 * z).abs() < 1e-9, "{led} N at {z} m");
    }
}

#[test]
fn a_line_of_one_station_equals_a_point() {
    let point = line(1, 0.0, 2.0, 400.0);
    let mut station = point;
    station.touches.swap(0, 5);
    let (mut a, mut b) = (Tool::touched(&point), Tool::touched(&station));
    for tick in 0..400 {
        let s = 1e-3 * f64::from(tick);
        let x = Vector3::new(0.02 * s, 0.005 * (9.0 * s).sin(), 0.004 * (7.0 * s).sin());
        let motion = Motion {
            v: Vector3::new(0.02, 0.0, 0.0),
            ..rest(&Pose::at(x))
        };
        assert_eq!(a.tick(&motion), b.tick(&motion));
    }
}

/// A hollow of 40 mm radius with a foundation of `k` N/m per station, pressed by a tilted line: only some stations
/// are in contact.
fn in_a_hollow(n: usize, pose: &Pose, k: f64) -> ContactModel {
    let mut model = ContactModel {
        x0: pose.position,
        turn0: pose.orientation,
        ..line(n, 0.06, 0.0, 0.0)
    };
    for touch in &mut model.touches[..n] {
        touch.lever = pose.orientation * touch.lever;
        let p = pose.position + touch.lever;
        let depth = 0.5 * p.x * p.x / 0.04 - p.z;
        let normal = Vector3::new(-p.x / 0.04, 0.0, 1.0).normalize();
        *touch = Touch {
            lever: touch.lever,
            touches: depth > 0.0,
            ..Touch::at_pivot(
                normal * (k * depth.max(0.0)),
                Matrix3::from_diagonal_element(k),
                normal,
            )
        };
    }
    model
}

#[test]
fn doubling_the_stations_changes_the_force_by_less_than_two_percent() {
    let tilt = UnitQuaternion::new(Vector3::new(0.0, 0.15, 0.0));
    for z in [0.0, -0.002, -0.006] {
        let pose = Pose {
            position: Vector3::new(0.003, 0.0, z),
            orientation: tilt,
        };
        let deeper = Pose {
            position: pose.position - Vector3::z() * 1e-3,
            ..pose
        };
        for now in [pose, deeper] {
            let felt = [8, 16].map(|n| {
                let model = in_a_hollow(n, &pose, 600.0 / n as f64);
                Tool::touched(&ContactModel {
                    radius: 1.0,
                    ..model
                })
                .tick(&rest(&now))
            });
            let off = (felt[1].force - felt[0].force).norm() / felt[1].force.norm();
            assert!(off < 0.02, "{z} m: {} % of {:?}", 100.0 * off, felt[1]);
        }
    }
}

/// Random steps of at most 0.17 mm and 3.5 mrad, then straight back.
fn closed_path(steps: &[(f64, f64, f64, f64, f64, f64)]) -> Vec<Pose> {
    let (mut x, mut turn) = (Vector3::zeros(), Vector3::zeros());
    let mut path = vec![(x, turn)];
    for &(a, b, c, d, e, f) in steps {
        x += Vector3::new(a, b, c) * 1e-4;
        turn += Vector3::new(d, e, f) * 2e-3;
        path.push((x, turn));
    }
    let back = (x.norm() / 1e-4).max(turn.norm() / 2e-3).ceil().max(1.0) as usize;
    path.extend((1..=back).map(|i| {
        let left = 1.0 - i as f64 / back as f64;
        (x * left, turn * left)
    }));
    let pose = |(x, turn)| Pose {
        position: x,
        orientation: UnitQuaternion::new(turn),
    };
    path.into_iter().map(pose).collect()
}

fn step() -> impl Strategy<Value = (f64, f64, f64, f64, f64, f64)> {
    let c = -1.0f64..1.0;
    (c.clone(), c.clone(), c.clone(), c.clone(), c.clone(), c)
}

proptest! {
    #[test]
    fn friction_of_every_contact_point_is_within_its_cone(
        steps in proptest::collection::vec(step(), 1..200),
        n in 1..=CONTACTS_MAX,
        squeeze in 0.0f64..1.0,
    ) {
        let mut model = line(n, 0.08, 1.0, 400.0);
        for touch in &mut model.touches {
            touch.pressed_n += squeeze;
            touch.damping = 0.3;
        }
        let mut tool = Tool::touched(&model);
        let mut before = Pose::default();
        for pose in closed_path(&steps) {
            let motion = Motion {
                v: (pose.position - before.position) * 1e3,
                w: turned(&before, &pose) * 1e3,
                ..rest(&pose)
            };
            tool.tick += 1;
            let mut worst = f64::NEG_INFINITY;
            tool.contact_points.advance_friction(&tool.blend, at(tool.tick), MS, &motion, |felt, across| {
                let limit = MU[0] * felt.contact.pressed;
                worst = worst.max(across.norm() - limit);
                worst = worst.max(across.dot(&felt.contact.normal).abs() - 1e-9);
            });
            prop_assert!(worst <= 1e-9, "{worst} N beyond the cone");
            before = pose;
        }
    }

    #[test]
    fn a_closed_path_with_rotation_creates_no_energy(
        steps in proptest::collection::vec(step(), 1..400),
        n in 1..=CONTACTS_MAX,
    ) {
        // Stiffness 400 N/m, pressed by 2 mm at the start: the path presses, slides, tilts and leaves.
        let mut tool = Tool::touched(&line(n, 0.06, 0.8, 400.0));
        let (mut work, mut before) = (0.0, None::<(Pose, Wrench)>);
        let path = closed_path(&steps);
        for pose in &path {
            let felt = tool.tick(&rest(pose));
            if let Some((last, held)) = &before {
                // The trapezium is exact for a linear spring; a held wrench would add the energy of the sampling.
                work += 0.5 * (felt.force + held.force).dot(&(pose.position - last.position));
                work += 0.5 * (felt.torque + held.torque).dot(&turned(last, pose));
            }
            before = Some((*pose, felt));
        }
        // Tolerance for the kinks of the one-sided law and of the cone, as for one contact point; a lever of 30 mm
        // moves by as much again.
        let tolerance = path.len() as f64 * 400.0 * 1.6e-7 / 8.0 * 1e-2 + 1e-6;
        prop_assert!(work <= tolerance, "the tool gained {work} J over {} steps", path.len());
    }
}
