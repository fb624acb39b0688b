//! The driver as a [`HapticDevice`](crate::HapticDevice).

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use nalgebra::Vector3;

use super::alarms::{Alarms, listen};
use super::session::Session;
use super::{HINT, Service, inventory};
use crate::backend::found::choose;
use crate::backend::mailbox::{DeviceState, Fade, LoopEnd, mailbox};
use crate::{
    Calibration, ClockOwner, DeviceCaps, DeviceFault, DeviceTime, ForceState, HapticDevice,
    OpenError, Sample, Workspace, Wrench, Written,
};

/// Messages without a new force before it fades, and for the fade: 20 ms each when the loop has stopped and a
/// message goes out every 2 ms.
const FADE: Fade = Fade::new(10, 10);

/// An open Inverse3.
#[derive(Debug)]
pub struct Haply {
    loop_end: LoopEnd,
    caps: DeviceCaps,
    leave: Arc<AtomicBool>,
    session: Option<JoinHandle<()>>,
    events: Option<JoinHandle<()>>,
}

impl Haply {
    pub(super) fn open(service: &Service, which: Option<&str>) -> Result<Self, OpenError> {
        let (link, message) = inventory(&service.simulation)?;
        let found = message.found();
        let chosen = &found[choose("haply", HINT, &found, which)?];
        let (mut loop_end, mut end) = mailbox(FADE);
        // Until the device has a valid position, the loop gets no state.
        let device_state = message.device_state(&chosen.id, &DeviceState::at_rest());
        if let Some(device_state) = device_state {
            end.publish(device_state);
        }
        loop_end.receive();
        let mut device = Self {
            loop_end,
            caps: caps(&chosen.name, &chosen.id, message.has_grip()),
            leave: Arc::default(),
            session: None,
            events: None,
        };
        let alarms: Arc<Alarms> = Arc::default();
        if let Some(url) = service.events.clone() {
            let (id, leave) = (chosen.id.clone(), Arc::clone(&device.leave));
            let alarms = Arc::clone(&alarms);
            let listening = move || listen(&url, &id, &alarms, &leave);
            device.events = Some(spawn("haply events", listening)?);
        }
        let session = Session {
            url: service.simulation.clone(),
            id: chosen.id.clone(),
            spelling: message.spelling(),
            end,
            device_state: device_state.unwrap_or_else(DeviceState::at_rest),
            alarms,
            leave: Arc::clone(&device.leave),
        };
        device.session = Some(spawn("haply", move || session.run(link))?);
        Ok(device)
    }

    /// Triggers the next message, without waiting.
    fn nudge(&self) {
        if let Some(session) = &self.session {
            session.thread().unpark();
        }
    }
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> Result<JoinHandle<()>, OpenError> {
    let builder = std::thread::Builder::new().name(name.to_owned());
    builder.spawn(work).map_err(|e| {
        OpenError::new(format_args!(
            "the system did not start a thread for the Haply service: {e}"
        ))
    })
}

/// Capabilities of an Inverse3. The service does not report them; the forces are modest for a desktop device, and
/// the box fits either hand. Widen them here by the maker's data sheet.
fn caps(name: &str, id: &str, has_grip: bool) -> DeviceCaps {
    DeviceCaps {
        name: format!("{name}, {id}"),
        dof_in: if has_grip { 6 } else { 3 },
        dof_out: 3,
        workspace: Workspace {
            min: Vector3::new(-0.25, -0.35, -0.15),
            max: Vector3::new(0.25, 0.1, 0.45),
        },
        max_force_n: 6.0,
        continuous_force_n: 3.0,
        max_torque_nm: 0.0,
        max_stiffness_n_per_m: 1000.0,
        rate_hz: 1000.0,
    }
}

impl HapticDevice for Haply {
    fn caps(&self) -> &DeviceCaps {
        &self.caps
    }

    fn calibration(&self) -> Calibration {
        self.loop_end.last().calibration
    }

    fn clock(&self) -> ClockOwner {
        ClockOwner::ReplyPerMessage
    }

    fn enable_forces(&mut self, on: bool) -> Result<(), DeviceFault> {
        let enabled = self.loop_end.enable(on);
        self.nudge();
        enabled
    }

    fn force_state(&self) -> ForceState {
        self.loop_end.motors().state()
    }

    fn read(&mut self, now: DeviceTime) -> Result<Sample, DeviceFault> {
        self.loop_end.read(now)
    }

    fn write(&mut self, now: DeviceTime, wrench: Wrench) -> Written {
        let written = self.loop_end.write(now, wrench, &self.caps);
        self.nudge();
        written
    }

    fn rendered(&self) -> Wrench {
        self.loop_end.rendered()
    }

    /// Zero force, then the end of the connection.
    fn close(&mut self) {
        self.loop_end.close();
        self.leave.store(true, Ordering::Release);
        for thread in [self.session.take(), self.events.take()]
            .into_iter()
            .flatten()
        {
            thread.thread().unpark();
            // A thread that panicked is over as well, and the service ends its session with it.
            let _ = thread.join();
        }
    }
}

impl Drop for Haply {
    fn drop(&mut self) {
        self.close();
    }
}
