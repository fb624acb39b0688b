//! The whole simulated device: assumed motors, simulated boards, and a scripted hand moved to the middle of the
//! workspace.

use nalgebra::Vector3;

use super::map::TILT_RAD;
use super::{Config, Drive, Encoder, FiveDof, Linkage, Middle, Rig, RigConfig};
use crate::backend::sim::ScriptStart;
use crate::{OpenError, Placed, Placement, Script};

/// The linkage and the encoders of 2007 with assumed motors: 1.5 N·m behind converters of 12 bits, and a force of 8
/// N peak and 4 N continuous.
pub fn invented() -> Config {
    Config {
        linkage: Linkage::default(),
        encoder: Encoder::default(),
        drive: Drive {
            torque_per_volt_nm: 0.2,
            full_scale_v: 10.0,
            bits: 12,
            limit_nm: 1.5,
        },
        force_n: [8.0, 4.0],
        torque_nm: 0.1,
        stiffness_n_per_m: 1000.0,
    }
}

/// The simulated device, held by a script of the scene. Its frame makes the tool upright at the first way point and
/// puts the middle of the script into the middle of the workspace. Later rotation about the probe is lost, as no
/// motor measures it.
pub fn simulated(script: &Script, start: ScriptStart) -> Result<Placed, OpenError> {
    let config = invented();
    let middle = Middle::of(&config.linkage)?;
    let upright = script.waypoints()[0].orientation;
    let placement = Placement::with(upright, middle.pivot, script.middle());
    let moved = script.seen_from(&placement)?;
    check(&moved, &middle)?;
    let rig = Rig::new(&config, RigConfig::default(), moved, start)?;
    let device = Box::new(FiveDof::open(rig, config)?);
    Ok(Placed::new(device, placement))
}

fn check(script: &Script, middle: &Middle) -> Result<(), OpenError> {
    let reach = middle.half_m * (1.0 + 1e-9);
    for (k, way) in script.waypoints().iter().enumerate() {
        let (number, t_s) = (k + 1, way.t_s);
        let away = (way.position - middle.pivot).amax();
        if away > reach {
            let (beyond, side) = ((away - reach) * 1e3, middle.half_m * 2e3);
            return Err(OpenError::new(format_args!(
                "way point {number} (t = {t_s} s) is {beyond:.1} mm outside of the workspace of this \
                 device, a cube of {side:.0} mm around the middle of the script; make the script smaller"
            )));
        }
        let tilt = (way.orientation * Vector3::y()).angle(&Vector3::y());
        if tilt > TILT_RAD {
            let (degrees, most) = (tilt.to_degrees(), TILT_RAD.to_degrees());
            return Err(OpenError::new(format_args!(
                "way point {number} (t = {t_s} s) tilts the probe by {degrees:.0} degrees from where it \
                 is at the first; this device takes {most:.0}"
            )));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::simulated;
    use crate::backend::sim::ScriptStart;
    use crate::script::{Hand, Tool, Waypoint};
    use crate::{DeviceTime, HapticDevice, Script};

    fn script(waypoints: Vec<Waypoint>) -> Script {
        let tool = Tool::probe(4e-3);
        Script::new(tool, Hand::default(), waypoints, false).unwrap()
    }

    #[test]
    fn it_follows_a_script_of_the_scene() {
        let waypoints = vec![
            Waypoint::new(0.0, Vector3::new(0.3, 0.1, 0.02)),
            Waypoint::new(1.0, Vector3::new(0.3, 0.12, -0.02)),
        ];
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, 1.9, -0.4));
        let script = script(waypoints.into_iter().map(|way| way.turned(turn)).collect());
        let start = ScriptStart::at(DeviceTime::ZERO);
        let mut device = simulated(&script, start).unwrap();
        for i in 0..1500 {
            let now = DeviceTime::from_micros(i * 1000);
            let sample = device.read(now).unwrap();
            let target = script.pose(now.as_secs_f64()).pose.position;
            assert!((sample.pose.position - target).norm() < 2e-3);
            assert!(sample.pose.orientation.angle_to(&turn) < 0.03);
            assert!(device.caps().workspace.contains(&sample.pose.position));
        }
    }

    #[test]
    fn an_infeasible_script_is_rejected_with_its_way_point() {
        let far = vec![
            Waypoint::new(0.0, Vector3::zeros()),
            Waypoint::new(2.5, Vector3::new(0.3, 0.0, 0.0)),
        ];
        let error = simulated(&script(far), ScriptStart::not_yet())
            .err()
            .unwrap();
        assert!(error.to_string().starts_with("way point 1 "), "{error}");
        let tilted = vec![
            Waypoint::new(0.0, Vector3::zeros()),
            Waypoint::new(2.5, Vector3::zeros())
                .turned(UnitQuaternion::from_euler_angles(0.8, 0.0, 0.0)),
        ];
        let error = simulated(&script(tilted), ScriptStart::not_yet())
            .err()
            .unwrap();
        let said = error.to_string();
        assert!(
            said.contains("way point 2 (t = 2.5 s) tilts the probe by 46 degrees"),
            "{said}"
        );
    }
}
