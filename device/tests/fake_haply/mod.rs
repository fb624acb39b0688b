//! A mock of the Haply service: it answers every message with one state, records orders, and misbehaves on request.
//! Its Inverse3 is 0.1 kg on a spring, one millisecond per message.

// Each test program uses a part of it.
#![allow(dead_code)]

use std::io::Write;
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::Duration;

use palpate_device::backend::haply::Service;
use serde_json::{Value, json};
use tungstenite::{Message, WebSocket};

/// Reaction to a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Manners {
    Good,
    /// No answer.
    Silent,
    /// An answer that is not JSON.
    Garbage,
    /// JSON without a state.
    NoState,
    /// A non-finite position.
    NotANumber,
    /// A state without the device.
    WithoutDevice,
    /// An answer of a megabyte.
    Huge,
    /// The beginning of an answer.
    Half,
    /// It closes the connection without a closing handshake.
    HangsUp,
}

/// State of the mock.
pub(crate) struct Told {
    pub(crate) manners: Manners,
    /// Spelled as since 3.5.
    pub(crate) is_new: bool,
    pub(crate) ids: Vec<&'static str>,
    pub(crate) calibrated: bool,
    pub(crate) powered: bool,
    /// Messages that were answered.
    pub(crate) answered: u64,
    pub(crate) heard: u64,
    /// The last valid force, N.
    pub(crate) force: [f64; 3],
    pub(crate) most_n: f64,
    /// Numbers per metre.
    pub(crate) unit: f64,
    /// Change of a force on its way to the motors.
    pub(crate) way: fn([f64; 3]) -> [f64; 3],
    /// Violations that a real service would reject.
    pub(crate) wrong: Vec<String>,
    events: Vec<String>,
    x: [f64; 3],
    v: [f64; 3],
}

impl Told {
    fn inventory(&self) -> String {
        self.message(true).to_string()
    }

    fn message(&self, is_first: bool) -> Value {
        let xyz = |v: [f64; 3]| json!({ "x": v[0], "y": v[1], "z": v[2] });
        let at = [self.x[0], self.x[1] - 0.12, self.x[2] + 0.15].map(|m| m * self.unit);
        let device = |id: &&str| {
            let mut state = json!({ "cursor_position": xyz(at), "cursor_velocity": xyz(self.v) });
            state[if self.is_new { "control_mode" } else { "mode" }] = json!("force");
            let mut device = json!({
                "device_id": id, "state": state,
                "status": { "calibrated": self.calibrated, "power_supply": self.powered, "ready": true },
            });
            if is_first {
                device["config"] = json!({ "type": "inverse3", "handedness": "right" });
            }
            device
        };
        let devices: Vec<Value> = self.ids.iter().map(device).collect();
        let grip = json!({ "device_id": "61548", "state": {
            "orientation": { "w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0 },
            "buttons": { "a": true, "b": false, "c": false },
        } });
        let mut message = json!({ "inverse3": devices, "wireless_verse_grip": [grip] });
        if self.is_new && is_first {
            message["session_id"] = json!(7);
        }
        message
    }

    /// Applies an order and advances by a millisecond.
    fn hear(&mut self, text: &str) {
        self.heard += 1;
        match self.order(text) {
            Ok(force) => self.force = (self.way)(force),
            Err(why) => self.wrong.push(format!("{why}: {text}")),
        }
        let n = self.force.iter().map(|f| f * f).sum::<f64>().sqrt();
        self.most_n = self.most_n.max(n);
        for i in 0..3 {
            let a = (self.force[i] - 400.0 * self.x[i] - 12.0 * self.v[i]) / 0.1;
            self.v[i] += a * 1e-3;
            self.x[i] += self.v[i] * 1e-3;
        }
    }

    fn order(&self, text: &str) -> Result<[f64; 3], &'static str> {
        let message: Value = serde_json::from_str(text).map_err(|_| "no JSON")?;
        let device = &message["inverse3"][0];
        let id = device["device_id"].as_str().ok_or("no device")?;
        if !self.ids.contains(&id) {
            return Err("another device");
        }
        let command = &device["commands"]["set_cursor_force"];
        let spelled = if self.is_new { "vector" } else { "values" };
        let number = |axis: &str| command[spelled][axis].as_f64().ok_or("not spelled so");
        Ok([number("x")?, number("y")?, number("z")?])
    }
}

struct Shared {
    told: Mutex<Told>,
    changed: Condvar,
    leave: AtomicBool,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Told> {
        self.told.lock().unwrap()
    }
}

/// The service, on its own ports.
pub(crate) struct Fake {
    shared: Arc<Shared>,
    pub(crate) service: Service,
    threads: Vec<JoinHandle<()>>,
    addresses: Vec<std::net::SocketAddr>,
}

impl Fake {
    pub(crate) fn start(is_new: bool, ids: &[&'static str]) -> Self {
        let shared = Arc::new(Shared {
            told: Mutex::new(Told {
                manners: Manners::Good,
                is_new,
                ids: ids.to_vec(),
                calibrated: true,
                powered: true,
                answered: 0,
                heard: 0,
                force: [0.0; 3],
                most_n: 0.0,
                unit: 1.0,
                way: |force| force,
                wrong: Vec::new(),
                events: Vec::new(),
                x: [0.0; 3],
                v: [0.0; 3],
            }),
            changed: Condvar::new(),
            leave: AtomicBool::new(false),
        });
        let (mut threads, mut addresses) = (Vec::new(), Vec::new());
        for serve in [states as fn(&Shared, TcpStream), events] {
            let listener = TcpListener::bind("127.0.0.1:0").unwrap();
            addresses.push(listener.local_addr().unwrap());
            let shared = Arc::clone(&shared);
            threads.push(std::thread::spawn(move || {
                // One connection at a time, any number in sequence.
                while let Ok((stream, _)) = listener.accept() {
                    if shared.leave.load(Ordering::Acquire) {
                        return;
                    }
                    serve(&shared, stream);
                }
            }));
        }
        let service = Service {
            simulation: format!("ws://{}", addresses[0]),
            events: Some(format!("ws://{}", addresses[1])),
        };
        Self {
            shared,
            service,
            threads,
            addresses,
        }
    }

    /// Reads or changes the state.
    pub(crate) fn with<T>(&self, f: impl FnOnce(&mut Told) -> T) -> T {
        let done = f(&mut self.shared.lock());
        self.shared.changed.notify_all();
        done
    }

    /// Waits for `n` more messages, for a second at most.
    pub(crate) fn hears(&self, n: u64) {
        let told = self.shared.lock();
        let until = told.heard + n;
        let wait = Duration::from_secs(1);
        drop(
            self.shared
                .changed
                .wait_timeout_while(told, wait, |t| t.heard < until),
        );
    }

    /// Waits for one more answer, up to the time in which a service answers.
    pub(crate) fn answers(&self) {
        let told = self.shared.lock();
        let until = told.answered + 1;
        let wait = Duration::from_millis(20);
        drop(
            self.shared
                .changed
                .wait_timeout_while(told, wait, |t| t.answered < until),
        );
    }

    /// Sends an event of the device.
    pub(crate) fn event(&self, id: &str, safety: &str, level: &str) {
        let data = json!({ "device_family": "inverse", "device_id": id, "safety_type": safety });
        let event = json!({ "name": "device-safety-triggered", "level": level, "data": data });
        self.with(|t| t.events.push(event.to_string()));
    }
}

impl Drop for Fake {
    fn drop(&mut self) {
        self.shared.leave.store(true, Ordering::Release);
        self.shared.changed.notify_all();
        for address in &self.addresses {
            // Lets `accept` return.
            let _ = TcpStream::connect(address);
        }
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

fn states(shared: &Shared, stream: TcpStream) {
    let _ = stream.set_nodelay(true);
    let _ = stream.set_read_timeout(Some(Duration::from_secs(2)));
    let Ok(mut socket) = tungstenite::accept(stream) else {
        return;
    };
    let (manners, inventory) = {
        let told = shared.lock();
        (told.manners, told.inventory())
    };
    let greeting = match manners {
        Manners::Silent => None,
        Manners::Garbage => Some("220 mail.example.org".to_owned()),
        _ => Some(inventory),
    };
    if let Some(greeting) = greeting {
        let _ = socket.send(Message::Text(greeting.into()));
    }
    let _ = socket
        .get_ref()
        .set_read_timeout(Some(Duration::from_millis(20)));
    while !shared.leave.load(Ordering::Acquire) {
        let text = match socket.read() {
            Ok(Message::Text(text)) => text,
            Ok(Message::Close(_)) => return,
            Ok(_) => continue,
            Err(tungstenite::Error::Io(why))
                if matches!(
                    why.kind(),
                    std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut
                ) =>
            {
                continue;
            }
            Err(_) => return,
        };
        let (manners, answer) = {
            let mut told = shared.lock();
            told.hear(&text);
            (told.manners, told.message(false))
        };
        if manners == Manners::HangsUp {
            shared.changed.notify_all();
            return;
        }
        if !answer_so(&mut socket, manners, answer) {
            return;
        }
        let mut told = shared.lock();
        told.answered += u64::from(manners != Manners::Silent);
        drop(told);
        shared.changed.notify_all();
    }
}

/// Whether the connection continues.
fn answer_so(socket: &mut WebSocket<TcpStream>, manners: Manners, mut answer: Value) -> bool {
    let text = match manners {
        Manners::Good => answer.to_string(),
        Manners::Silent | Manners::HangsUp => return true,
        Manners::Garbage => "\u{1}\u{2} not JSON".to_owned(),
        Manners::NoState => r#"{"error":"internal"}"#.to_owned(),
        Manners::NotANumber => {
            answer["inverse3"][0]["state"]["cursor_position"]["x"] = json!(1e308);
            // Text that a careless program writes for NaN.
            answer
                .to_string()
                .replace("1e308", "1e999")
                .replace("1e+308", "NaN")
        }
        Manners::WithoutDevice => r#"{"inverse3":[]}"#.to_owned(),
        Manners::Huge => format!("{{\"inverse3\":[],\"more\":\"{}\"}}", "x".repeat(1 << 20)),
        Manners::Half => {
            // A text frame that announces 1000 bytes and has ten.
            let _ = socket.get_mut().write_all(&[0x81, 126, 0x03, 0xe8]);
            let _ = socket.get_mut().write_all(b"{\"inverse3");
            return true;
        }
    };
    socket.send(Message::Text(text.into())).is_ok()
}

fn events(shared: &Shared, stream: TcpStream) {
    let Ok(mut socket) = tungstenite::accept(stream) else {
        return;
    };
    let mut told = shared.lock();
    while !shared.leave.load(Ordering::Acquire) {
        let new = std::mem::take(&mut told.events);
        drop(told);
        for event in new {
            if socket.send(Message::Text(event.into())).is_err() {
                return;
            }
        }
        told = shared.lock();
        told = shared
            .changed
            .wait_timeout(told, Duration::from_millis(50))
            .unwrap()
            .0;
    }
}
