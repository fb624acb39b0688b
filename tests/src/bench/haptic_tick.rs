//! `bench haptic-tick`: duration of one tick of the force loop.
//!
//! A hand presses, slides and tilts a line of 1, 4 and 16 stations on a linear tissue; its contact model is
//! renewed every fourth tick. One time covers the device read, the chain and the device write, that is all work
//! between two waits. The other covers the chain alone, because simulated motors and links are not part of it.
//! Both devices render torques: the simulated hand has six degrees of freedom (the script sets its rotation),
//! the 5-DOF device two rotational ones.

use std::fmt;
use std::time::Instant;

use clap::Args;
use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use palpate_device::backend::five_dof;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::script::{Hand, Tool, Waypoint};
use palpate_device::{DeviceCaps, DeviceTime, HapticDevice, Pose, Script};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Touch};
use palpate_protocol::ClientTime;
use serde::Serialize;

use super::{Benchmark, OnStage};

/// Untimed ticks at the beginning: the soft start.
const WARM: usize = 2000;
const CONTACTS: [usize; 3] = [1, 4, 16];
const LENGTH_M: f64 = 0.04;

#[derive(Debug, Clone, Copy, Args)]
pub struct HapticTick {
    /// Ticks of each device
    #[arg(long, default_value_t = 200_000, value_parser = clap::value_parser!(u32).range(1000..=100_000_000))]
    pub ticks: u32,
}

impl Benchmark for HapticTick {
    type Report = HapticTickReport;

    fn measure(&self, _: &mut OnStage<'_>) -> Result<HapticTickReport, String> {
        let start = || ScriptStart::at(DeviceTime::ZERO);
        let script = script().map_err(|e| e.to_string())?;
        let mut devices = Vec::new();
        for contacts in CONTACTS {
            let caps = DeviceCaps {
                dof_out: 6,
                max_torque_nm: 0.5,
                ..SimHand::new(script.clone(), start()).caps().clone()
            };
            let mut hand = SimHand::with_caps(script.clone(), start(), caps);
            let mut five = five_dof::simulated(&script, start()).map_err(|e| e.to_string())?;
            devices.push(self.time(&mut hand, contacts)?);
            devices.push(self.time(&mut five, contacts)?);
        }
        Ok(HapticTickReport {
            ticks: self.ticks,
            devices,
        })
    }
}

#[derive(Debug, Clone, Copy, Serialize)]
pub struct Quantiles {
    pub p50_us: f64,
    pub p99_us: f64,
    pub p999_us: f64,
    pub max_us: f64,
}

impl Quantiles {
    fn of(times: &[f64]) -> Self {
        let at = |q| super::quantile(times, q);
        Self {
            p50_us: at(0.5),
            p99_us: at(0.99),
            p999_us: at(0.999),
            max_us: at(1.0),
        }
    }
}

#[derive(Debug, Clone, Serialize)]
pub struct Times {
    pub device: String,
    pub contacts: usize,
    #[serde(flatten)]
    pub tick: Quantiles,
    pub chain: Quantiles,
    pub in_contact: u64,
    pub slip: u64,
    pub max_torque_nm: f64,
}

#[derive(Debug, Clone, Serialize)]
pub struct HapticTickReport {
    pub ticks: u32,
    pub devices: Vec<Times>,
}

impl HapticTick {
    fn time(self, device: &mut dyn HapticDevice, contacts: usize) -> Result<Times, String> {
        device.enable_forces(true).map_err(|e| e.to_string())?;
        let mut chain = Chain::new(ChainConfig::default(), device.caps());
        let mut model = ContactModel::FREE;
        let mut whole = Vec::with_capacity(self.ticks as usize);
        let mut alone = Vec::with_capacity(self.ticks as usize);
        for tick in 0..self.ticks as usize + WARM {
            let us = 1000 * tick as i64;
            let (device_now, now) = (DeviceTime::from_micros(us), ClientTime::from_micros(us));
            let began = Instant::now();
            let sample = device.read(device_now).map_err(|e| e.to_string())?;
            let was_read = Instant::now();
            let given = chain.tick(now, &sample, &model);
            let was_computed = Instant::now();
            let _ = device.write(device_now, given.wrench);
            let was_written = Instant::now();
            if tick >= WARM {
                let us = |from: Instant, to: Instant| (to - from).as_secs_f64() * 1e6;
                whole.push(us(began, was_written));
                alone.push(us(was_read, was_computed));
            }
            if tick % 4 == 0 {
                model = tissue(now, &sample.pose, contacts);
            }
        }
        let counters = chain.counters();
        Ok(Times {
            device: device.caps().name.clone(),
            contacts,
            tick: Quantiles::of(&whole),
            chain: Quantiles::of(&alone),
            in_contact: counters.in_contact,
            slip: counters.slip,
            max_torque_nm: counters.max_torque_nm,
        })
    }
}

fn script() -> Result<Script, palpate_device::ScriptError> {
    let tool = Tool::probe(4e-3);
    let tremor = Hand {
        tremor_m: 2e-4,
        ..Hand::default()
    };
    let waypoints = [
        (0.0, [0.0, 0.0, 0.01]),
        (0.5, [0.0, 0.0, -0.02]),
        (1.5, [0.04, 0.0, -0.02]),
        (2.0, [0.0, 0.0, 0.01]),
    ];
    let mut waypoints = waypoints.map(|(t, at)| Waypoint::new(t, Vector3::from(at)));
    waypoints[2] = waypoints[2].turned(UnitQuaternion::new(Vector3::new(0.15, 0.0, 0.0)));
    Script::new(tool, tremor, waypoints.into(), true)
}

/// Contact model of a line along the probe axis (y) on a half-space of 300 N/m below z = 0.
fn tissue(now: ClientTime, pose: &Pose, contacts: usize) -> ContactModel {
    let mut model = ContactModel {
        topology_version: 1,
        solved_at: now,
        x0: pose.position,
        turn0: pose.orientation,
        radius: 8e-3,
        ..ContactModel::FREE
    };
    let share = 1.0 / contacts as f64;
    let stiffness = Matrix3::from_diagonal_element(300.0 * share);
    for (i, touch) in model.touches[..contacts].iter_mut().enumerate() {
        let along = LENGTH_M * ((i as f64 + 0.5) * share - 0.5);
        let lever = pose.orientation * (Vector3::y() * along);
        let depth = -(pose.position + lever).z;
        let f0 = Vector3::z() * (300.0 * share * depth.max(0.0));
        *touch = Touch {
            touches: depth > 0.0,
            lever,
            damping: 0.3 * share,
            mu_static: 0.3,
            mu_dynamic: 0.2,
            ..Touch::at_pivot(f0, stiffness, Vector3::z())
        };
    }
    model
}

impl fmt::Display for HapticTickReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:<16} {:>8}  {:^35}  chain alone",
            "", "contacts", "tick"
        )?;
        write!(f, "{:<16} {:>8}", "", "")?;
        for _ in 0..2 {
            write!(f, " {:>8} {:>8} {:>8} {:>8}", "p50", "p99", "p99.9", "max")?;
        }
        write!(f, " µs")?;
        for d in &self.devices {
            write!(f, "\n{:<16} {:>8}", d.device, d.contacts)?;
            for q in [&d.tick, &d.chain] {
                let all = [q.p50_us, q.p99_us, q.p999_us, q.max_us];
                for us in all {
                    write!(f, " {us:>8.2}")?;
                }
            }
        }
        write!(f, "\n{} ticks of each", self.ticks)
    }
}
