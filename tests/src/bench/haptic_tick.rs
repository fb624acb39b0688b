//! `bench haptic-tick`: what one tick of the force loop costs.
//!
//! A hand presses and slides on a linear tissue whose model is renewed every fourth tick. Timed are the reading of the
//! device, the chain, and the writing: all that happens between two waits.

use std::fmt;
use std::time::Instant;

use nalgebra::{Matrix3, Vector3};
use palpate_device::backend::five_dof;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::script::{Hand, Tool, ToolKind, WayPoint};
use palpate_device::{DeviceTime, HapticDevice, Script};
use palpate_haptics::{Chain, ChainConfig, ContactModel, Touch};
use palpate_protocol::ClientTime;
use serde::Serialize;

/// Ticks before the clock runs: the soft start.
const WARM: usize = 2000;

/// What is to be measured.
#[derive(Debug, Clone, Copy)]
pub struct HapticTick {
    /// Ticks of each device.
    pub ticks: usize,
}

/// Times of one device, in µs.
#[derive(Debug, Clone, Serialize)]
pub struct Times {
    /// What the device calls itself.
    pub device: String,
    /// Half are shorter.
    pub p50_us: f64,
    /// 99 of 100.
    pub p99_us: f64,
    /// 999 of 1000.
    pub p999_us: f64,
    /// The longest.
    pub max_us: f64,
    /// Ticks in contact.
    pub in_contact: u64,
}

/// Times of all devices.
#[derive(Debug, Clone, Serialize)]
pub struct HapticTickReport {
    /// Ticks of each.
    pub ticks: usize,
    /// One row per device.
    pub devices: Vec<Times>,
}

impl HapticTick {
    /// Runs it.
    ///
    /// # Errors
    ///
    /// When a device can not follow the script.
    pub fn run(self) -> Result<HapticTickReport, String> {
        let start = || ScriptStart::at(DeviceTime::ZERO);
        let script = script().map_err(|e| e.to_string())?;
        let mut hand = SimHand::new(script.clone(), start());
        let mut five = five_dof::simulated(&script, start()).map_err(|e| e.to_string())?;
        let devices = [self.time(&mut hand)?, self.time(&mut five)?];
        Ok(HapticTickReport {
            ticks: self.ticks,
            devices: devices.into(),
        })
    }

    fn time(self, device: &mut dyn HapticDevice) -> Result<Times, String> {
        device.enable_forces(true).map_err(|e| e.to_string())?;
        let mut chain = Chain::new(ChainConfig::default(), device.caps());
        let mut model = ContactModel::FREE;
        let mut times = Vec::with_capacity(self.ticks);
        for tick in 0..self.ticks + WARM {
            let us = 1000 * tick as i64;
            let (device_now, now) = (DeviceTime::from_micros(us), ClientTime::from_micros(us));
            let began = Instant::now();
            let sample = device.read(device_now).map_err(|e| e.to_string())?;
            let given = chain.tick(now, &sample, &model);
            let _ = device.write(device_now, given.wrench);
            let took = began.elapsed();
            if tick >= WARM {
                times.push(took.as_secs_f64() * 1e6);
            }
            if tick % 4 == 0 {
                model = tissue(now, sample.pose.position);
            }
        }
        let at = |q| super::quantile(&times, q);
        Ok(Times {
            device: device.caps().name.clone(),
            p50_us: at(0.5),
            p99_us: at(0.99),
            p999_us: at(0.999),
            max_us: at(1.0),
            in_contact: chain.counters().in_contact,
        })
    }
}

/// A press that slides, over and over.
fn script() -> Result<Script, palpate_device::ScriptError> {
    let tool = Tool {
        kind: ToolKind::Probe,
        radius_m: 4e-3,
        length_m: 0.0,
    };
    let tremor = Hand {
        tremor_m: 2e-4,
        ..Hand::default()
    };
    let ways = [
        (0.0, [0.0, 0.0, 0.01]),
        (0.5, [0.0, 0.0, -0.02]),
        (1.5, [0.04, 0.0, -0.02]),
        (2.0, [0.0, 0.0, 0.01]),
    ];
    let ways = ways.map(|(t, at)| WayPoint::new(t, Vector3::from(at)));
    Script::new(tool, tremor, ways.into(), true)
}

fn tissue(now: ClientTime, x: Vector3<f64>) -> ContactModel {
    let depth = (-x.z).max(0.0);
    let f0 = Vector3::new(0.0, 0.0, 300.0 * depth);
    ContactModel {
        topology_version: 1,
        solved_at: now,
        x0: x,
        radius: 8e-3,
        ..ContactModel::single(Touch {
            touches: depth > 0.0,
            damping: 0.3,
            mu_static: 0.3,
            mu_dynamic: 0.2,
            ..Touch::at_pivot(f0, Matrix3::from_diagonal_element(300.0), Vector3::z())
        })
    }
}

impl fmt::Display for HapticTickReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:<16} {:>8} {:>8} {:>8} {:>8} µs",
            "", "p50", "p99", "p99.9", "max"
        )?;
        for d in &self.devices {
            write!(
                f,
                "\n{:<16} {:>8.2} {:>8.2} {:>8.2} {:>8.2}",
                d.device, d.p50_us, d.p99_us, d.p999_us, d.max_us
            )?;
        }
        write!(f, "\n{} ticks of each, one contact", self.ticks)
    }
}
