//! The nodes that a page draws against those of the replica, over a press and a cut.

#![allow(clippy::unwrap_used)]

use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use palpate_protocol::ServerTime;
use palpate_tissue::{BladePoint, Budget, CutStroke, Material, Tissue, Tool, Vec3, block};
use palpate_view::{Feed, PageEvent, PageInput, ViewConfig, ViewListener, ViewServer, Welcome};
use tokio::net::TcpStream;
use tokio::sync::mpsc::Receiver;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async};

/// Maximum distance of a drawn node from that of the replica, m.
const ERROR_MAX_M: f64 = 0.05e-3;

/// Time between two displayed times, µs.
const TICK_US: i64 = 33_333;

const HELLO: &str = r#"{"type":"hello","version":1,"grant":"0123456789abcdef0123456789abcdef"}"#;

/// A page that decodes as the format requires.
struct Page {
    socket: WebSocketStream<MaybeTlsStream<TcpStream>>,
    version: u32,
    /// Numbers of the drawn nodes in the model, and where they are at rest, m.
    nodes: Vec<u32>,
    rest: Vec<[f32; 3]>,
    /// Displacements, m.
    moved: Vec<[f32; 3]>,
    shape: Option<u32>,
    /// The displayed time, µs.
    time_us: f64,
    changes: usize,
}

fn number<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    bytes[at..at + N].try_into().unwrap()
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(number(bytes, at))
}

fn f32_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(number(bytes, at))
}

impl Page {
    async fn join(view: &ViewServer, inputs: &mut Receiver<PageInput>) -> Self {
        let url = format!("ws://{}/session", view.address().socket);
        let (mut socket, _) = connect_async(url).await.unwrap();
        socket.send(Message::text(HELLO)).await.unwrap();
        let input = inputs.recv().await.unwrap();
        assert!(matches!(input.event, PageEvent::Hello(_)));
        view.welcome(
            input.page,
            &Welcome {
                participant: 1,
                name: "ann".to_owned(),
                role: "trainee",
                source: "replica",
                can_steer: false,
                tick_hz: 30,
                regions: Vec::new(),
                seat: None,
            },
        );
        Self {
            socket,
            version: u32::MAX,
            nodes: Vec::new(),
            rest: Vec::new(),
            moved: Vec::new(),
            shape: None,
            time_us: f64::NAN,
            changes: 0,
        }
    }

    /// Reads until the displayed time is shown; `false` if nothing arrives for a while.
    async fn read_until(&mut self, s: ServerTime) -> bool {
        while self.time_us != s.as_micros() as f64 {
            let wait = Duration::from_millis(200);
            let Ok(message) = tokio::time::timeout(wait, self.socket.next()).await else {
                return false;
            };
            if let Message::Binary(bytes) = message.unwrap().unwrap() {
                match bytes[0] {
                    1 => self.take_surface(&bytes),
                    2 => self.take_shape(&bytes),
                    kind => panic!("kind {kind}"),
                }
            }
        }
        true
    }

    fn take_surface(&mut self, bytes: &[u8]) {
        let length = u32_at(bytes, 4) as usize;
        let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
        let count = header["nodes"].as_u64().unwrap() as usize;
        let (numbers, places) = (8 + length, 8 + length + 4 * count);
        let place = |k: usize| [0, 1, 2].map(|a| f32_at(bytes, places + 12 * k + 4 * a));
        self.version = header["version"].as_u64().unwrap() as u32;
        self.nodes = (0..count).map(|k| u32_at(bytes, numbers + 4 * k)).collect();
        self.rest = (0..count).map(place).collect();
        self.moved = vec![[0.0; 3]; count];
        self.shape = None;
    }

    fn take_shape(&mut self, bytes: &[u8]) {
        let is_full = bytes[1] == 1;
        let [version, shape, count] = [4, 8, 12].map(|at| u32_at(bytes, at));
        if version != self.version || !is_full && self.shape != shape.checked_sub(1) {
            return;
        }
        let step = f32_at(bytes, 16);
        let count = count as usize;
        let steps = if is_full { 36 } else { 36 + 4 * count };
        for k in 0..count {
            let node = if is_full {
                k
            } else {
                u32_at(bytes, 36 + 4 * k) as usize
            };
            self.moved[node] = [0, 1, 2].map(|a| {
                step * f32::from(i16::from_le_bytes(number(bytes, steps + 6 * k + 2 * a)))
            });
        }
        self.shape = Some(shape);
        self.changes += usize::from(!is_full);
        self.time_us = f64::from_le_bytes(number(bytes, 20));
    }

    /// Largest distance of a drawn node from that of the replica, m.
    fn error_m(&self, tissue: &Tissue) -> f64 {
        assert_eq!(self.version, tissue.topology().version());
        let error = |k: usize| {
            let node = self.nodes[k];
            let [rest, moved] = [self.rest[k], self.moved[k]].map(|v| Vec3::from(v.map(f64::from)));
            let own = tissue.topology().rest(node) + tissue.shape().displacement[node as usize];
            (rest + moved - own).norm()
        };
        (0..self.nodes.len()).map(error).fold(0.0, f64::max)
    }
}

/// The replica that is shown, and its page.
struct Shown {
    tissue: Tissue,
    feed: Feed,
    page: Page,
    s: ServerTime,
}

impl Shown {
    /// Solves with the tool at a height, shows the shape and compares what the page draws.
    async fn tick(&mut self, height_m: f64) {
        self.s = ServerTime::from_micros(self.s.as_micros() + TICK_US);
        let tool = Tool::ball(1, Vec3::new(0.0301, 0.0302, height_m), 0.008);
        self.tissue.step(&[tool], Budget::new(20, 1e-2));
        // The first update of a version is its surface; a shape follows once the hub has drawn it.
        for _ in 0..100 {
            let (tissue, at) = (&self.tissue, (self.s, false));
            self.feed.show(tissue.topology(), tissue.shape(), at, &[]);
            if self.page.read_until(self.s).await {
                let error_m = self.page.error_m(&self.tissue);
                assert!(error_m <= ERROR_MAX_M, "{error_m} m at {:?}", self.s);
                return;
            }
        }
        panic!("no shape of {:?}", self.s);
    }
}

#[tokio::test]
async fn drawn_nodes_agree_with_the_replica_over_a_press_and_a_cut() {
    let config = ViewConfig::local(
        ViewListener::bind("127.0.0.1:0".parse().unwrap()).unwrap(),
        || ServerTime::ZERO,
    );
    let runtime = tokio::runtime::Handle::current();
    let (view, feed, mut inputs) = ViewServer::start(config, &runtime).unwrap();
    let page = Page::join(&view, &mut inputs).await;
    let model = block([15, 15, 8], 0.004, &Material::default(), 1);
    let mut shown = Shown {
        tissue: Tissue::new(model.into()),
        feed,
        page,
        s: ServerTime::ZERO,
    };
    // The top is at 32 mm and the tool reaches 8 mm below its centre.
    let press: Vec<f64> = (0..20).map(|k| 0.041 - 0.4e-3 * f64::from(k)).collect();
    for height_m in &press {
        shown.tick(*height_m).await;
    }
    let displacement = &shown.tissue.shape().displacement;
    let deepest_m = displacement.iter().map(Vec3::norm).fold(0.0, f64::max);
    assert!(
        deepest_m > 3e-3,
        "the press moved no node by more than {deepest_m} m"
    );
    let drawn_before = shown.page.nodes.len();
    let point = |y| BladePoint {
        tip: Vec3::new(0.0401, y, 0.02),
        axis: Vec3::z(),
        depth_m: 0.02,
    };
    let stroke = CutStroke {
        points: vec![point(-0.01), point(0.03), point(0.07)],
        width_m: 0.0,
    };
    shown.tissue.cut(&stroke).unwrap();
    for height_m in press.iter().rev() {
        shown.tick(*height_m).await;
    }
    assert_eq!(shown.page.version, 1);
    assert!(
        shown.page.nodes.len() > drawn_before,
        "walls of the wound are drawn"
    );
    assert!(shown.page.changes > 20, "{} changes", shown.page.changes);
}
