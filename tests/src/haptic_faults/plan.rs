//! The run of a seed: hand, tissue, device and faults.

use clap::ValueEnum;
use nalgebra::{Unit, Vector3};
use palpate_client::realtime::ENABLE_EVERY;
use palpate_device::script::{Hand, Tool, Waypoint};
use palpate_device::{DeviceCaps, Script, ScriptError};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::fault::{Class, Fault};
use super::faulty_device::{DeviceWatchdog, Driver};
use super::tissue::Tissue;

/// Tissue stiffnesses, N/m: fat, muscle, cartilage, bone.
const STIFFNESSES: [f64; 5] = [200.0, 600.0, 1500.0, 5000.0, 20_000.0];
const SPEED_MAX: f64 = 0.5;

/// Time from the last fault to the check of the returned force, µs: it covers the soft start.
const RECOVERY_US: i64 = 1_300_000;

/// The same for a device that has to be enabled again; the loop retries once a second.
const SWITCHED_ON_US: i64 = RECOVERY_US + ENABLE_EVERY.as_micros();

/// Length of the recovery window, µs: two presses.
const LOOK_US: i64 = 1_000_000;

#[derive(Debug, Clone)]
pub struct Plan {
    pub seed: u64,
    pub class: Class,
    /// The faults, ordered by begin.
    pub faults: Vec<Fault>,
    pub script: Script,
    pub tissue: Tissue,
    pub driver: Driver,
    pub caps: DeviceCaps,
    /// End of the last fault, µs of the run.
    pub over_us: i64,
    /// Time at which the force must have returned, µs of the run.
    pub back_us: i64,
    pub length_us: i64,
}

impl Plan {
    pub fn of(seed: u64, caps: &DeviceCaps) -> Result<Self, ScriptError> {
        let mut rng = Pcg64::seed_from_u64(seed);
        let class = Class::of_seed(seed);
        let faults = faults(class, &mut rng);
        let over_us = faults.iter().map(|f| f.until_us).max().unwrap_or(0);
        let driver = driver(&mut rng);
        let needs_switching = driver.watchdog.is_some_and(|w| w.turns_off)
            || faults.iter().any(|f| f.what.class() == Class::Unplugged);
        let back_us = over_us
            + if needs_switching {
                SWITCHED_ON_US
            } else {
                RECOVERY_US
            };
        let length_us = back_us + LOOK_US;
        let tissue = tissue(&mut rng);
        let script = script(&tissue, length_us, &mut rng)?;
        let (max_force_n, continuous_force_n) =
            [(20.0, 10.0), (8.0, 3.3), (60.0, 40.0)][rng.random_range(0..3)];
        Ok(Self {
            seed,
            class,
            faults,
            script,
            tissue,
            driver,
            caps: DeviceCaps {
                max_force_n,
                continuous_force_n,
                ..caps.clone()
            },
            over_us,
            back_us,
            length_us,
        })
    }

    #[must_use]
    pub fn without_faults(&self) -> Self {
        Self {
            faults: Vec::new(),
            ..self.clone()
        }
    }
}

fn faults(class: Class, rng: &mut Pcg64) -> Vec<Fault> {
    // The soft start ends after one second; some faults begin within it.
    let from_us = rng.random_range(900_000..2_000_000);
    if class != Class::Several {
        return vec![Fault::random(class, from_us, rng)];
    }
    let classes = Class::value_variants();
    let mut faults: Vec<Fault> = (0..rng.random_range(2..=4))
        .map(|_| {
            let class = classes[rng.random_range(0..classes.len() - 1)];
            let from_us = from_us + rng.random_range(0..300_000);
            Fault::random(class, from_us, rng)
        })
        .collect();
    faults.sort_by_key(|f| f.from_us);
    faults
}

fn tissue(rng: &mut Pcg64) -> Tissue {
    let tilt = Vector3::new(
        rng.random_range(-0.5..0.5),
        rng.random_range(-0.5..0.5),
        1.0,
    );
    let mu_static = rng.random_range(0.05..0.6);
    Tissue {
        normal: Unit::new_normalize(tilt),
        stiffness: STIFFNESSES[rng.random_range(0..STIFFNESSES.len())],
        damping: rng.random_range(0.0..2.0),
        mu_static,
        mu_dynamic: mu_static * rng.random_range(0.4..1.0),
        delay_us: rng.random_range(500..4_000),
        phase_us: rng.random_range(0..4_000),
    }
}

fn driver(rng: &mut Pcg64) -> Driver {
    let after_us = rng.random_range(5_000..100_000);
    Driver {
        ramps: rng.random_bool(0.5),
        leaps_after_pause: rng.random_bool(0.3),
        watchdog: [
            None,
            Some(DeviceWatchdog {
                after_us,
                turns_off: false,
            }),
            Some(DeviceWatchdog {
                after_us,
                turns_off: true,
            }),
        ][rng.random_range(0..3)],
    }
}

/// Presses in, slides and retracts until the end of the run. The last press starts from outside and holds.
fn script(tissue: &Tissue, length_us: i64, rng: &mut Pcg64) -> Result<Script, ScriptError> {
    let tool = Tool::probe(4e-3);
    let hand = Hand {
        mass_kg: rng.random_range(0.1..0.6),
        stiffness_n_per_m: rng.random_range(200.0..1200.0),
        damping_ns_per_m: rng.random_range(8.0..30.0),
        tremor_m: rng.random_range(0.0..3e-4),
        seed: rng.random_range(0..1 << 62),
    };
    let end_s = length_us as f64 * 1e-6;
    let presses_again_s = end_s - 0.8 * LOOK_US as f64 * 1e-6;
    let out = |rng: &mut Pcg64| rng.random_range(0.002..0.02);
    let mut t_s = rng.random_range(0.3..0.8);
    let mut at = tissue.above(0.02, 0.0, 0.0);
    let mut waypoints = vec![Waypoint::new(0.0, at), Waypoint::new(t_s, at)];
    while t_s < presses_again_s {
        let away = if rng.random_bool(0.15) {
            out(rng)
        } else {
            -rng.random_range(0.003..0.03)
        };
        let side = Vector3::new(
            rng.random_range(-0.03..0.03),
            rng.random_range(-0.03..0.03),
            0.0,
        );
        let to = tissue.above(away, side.x, side.y);
        // Peak speed of a minimum-jerk motion is 15/8 of the mean.
        let shortest_s = 1.875 * (to - at).norm() / SPEED_MAX;
        t_s += rng.random_range(shortest_s.max(0.06)..shortest_s.max(0.06) + 0.5);
        let way = Waypoint::new(t_s, to);
        waypoints.push(if rng.random_bool(0.2) {
            way.linear()
        } else {
            way
        });
        at = to;
    }
    for (after_s, away) in [(0.25, 0.004), (0.5, -0.015)] {
        waypoints.push(Waypoint::new(t_s + after_s, tissue.above(away, 0.0, 0.0)));
    }
    Script::new(tool, hand, waypoints, false)
}
