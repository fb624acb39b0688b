//! A page against a real server: files, admission, limits.

#![allow(clippy::unwrap_used)]

use std::collections::BTreeSet;
use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use palpate_protocol::ServerTime;
use palpate_view::{
    Feed, PageEvent, PageId, PageInput, State, ToolFrame, ViewConfig, ViewListener, ViewServer,
    Welcome,
};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::sync::mpsc::Receiver;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async};

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

const HELLO: &str = r#"{"type":"hello","version":1,"name":"ann","role":"spectator",
    "grant":"0123456789abcdef0123456789abcdef","tool":null,"seat":null}"#;

struct Host {
    view: ViewServer,
    inputs: Receiver<PageInput>,
    _feed: Feed,
}

impl Host {
    fn start() -> Self {
        let config = ViewConfig::local(
            ViewListener::bind("127.0.0.1:0".parse().unwrap()).unwrap(),
            || ServerTime::from_micros(7_000_000),
        );
        let (view, feed, inputs) =
            ViewServer::start(config, &tokio::runtime::Handle::current()).unwrap();
        Self {
            view,
            inputs,
            _feed: feed,
        }
    }

    async fn open(&self) -> Socket {
        let url = format!("ws://{}/session", self.view.address().socket);
        let (socket, _) = connect_async(url).await.unwrap();
        socket
    }

    /// A page that takes part.
    async fn join(&mut self) -> Socket {
        let mut socket = self.open().await;
        socket.send(Message::text(HELLO)).await.unwrap();
        let input = self.inputs.recv().await.unwrap();
        assert!(matches!(input.event, PageEvent::Hello(hello) if hello.name == "ann"));
        self.view.welcome(input.page, &welcome());
        assert_eq!(text(&mut socket).await["type"], "welcome");
        socket
    }

    async fn get(&self, path: &str, headers: &str) -> String {
        let mut stream = TcpStream::connect(self.view.address().socket)
            .await
            .unwrap();
        let request = format!(
            "GET {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n{headers}\r\n",
            self.view.address().socket
        );
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).await.unwrap();
        String::from_utf8_lossy(&answer).into_owned()
    }
}

fn welcome() -> Welcome {
    Welcome {
        participant: 1,
        name: "ann".to_owned(),
        role: "spectator",
        source: "server",
        can_steer: false,
        tick_hz: 30,
        regions: Vec::new(),
        seat: None,
    }
}

/// The next text of a page as JSON.
async fn text(socket: &mut Socket) -> serde_json::Value {
    loop {
        match next(socket).await {
            Message::Text(text) => return serde_json::from_str(&text).unwrap(),
            Message::Close(frame) => panic!("closed: {frame:?}"),
            _ => {}
        }
    }
}

async fn next(socket: &mut Socket) -> Message {
    let message = tokio::time::timeout(Duration::from_secs(20), socket.next()).await;
    message.expect("nothing came").unwrap().unwrap()
}

/// Code and sentence of the close; frames before it are ignored.
async fn closed(socket: &mut Socket) -> (u16, String) {
    loop {
        if let Message::Close(Some(frame)) = next(socket).await {
            return (frame.code.into(), frame.reason.to_string());
        }
    }
}

#[tokio::test]
async fn files_have_a_strict_policy_and_others_do_not_exist() {
    let host = Host::start();
    let page = host.get("/", "").await;
    assert!(page.starts_with("HTTP/1.1 200"), "{page}");
    for part in [
        "default-src 'none'",
        "frame-ancestors 'none'",
        "nosniff",
        "no-referrer",
        "text/html",
    ] {
        assert!(page.contains(part), "{part}: {page}");
    }
    assert!(
        host.get("/", "Accept-Encoding: gzip\r\n")
            .await
            .contains("content-encoding: gzip")
    );
    for path in ["/../Cargo.toml", "/secret", "/assets/"] {
        assert!(
            host.get(path, "").await.starts_with("HTTP/1.1 404"),
            "{path}"
        );
    }
}

#[tokio::test]
async fn foreign_origin_is_refused() {
    let host = Host::start();
    let mut request = format!("ws://{}/session", host.view.address().socket)
        .into_client_request()
        .unwrap();
    request
        .headers_mut()
        .insert("Origin", "http://evil.example".parse().unwrap());
    let error = connect_async(request).await.unwrap_err().to_string();
    assert!(error.contains("403"), "{error}");
}

#[tokio::test]
async fn admitted_page_gets_state_tools_and_answers_to_pings() {
    let mut host = Host::start();
    host.view.show_state(&State::default());
    let mut page = host.join().await;
    assert_eq!(text(&mut page).await["type"], "state");
    page.send(Message::text(r#"{"type":"ping","id":4,"sent_ms":1.5}"#))
        .await
        .unwrap();
    let pong = text(&mut page).await;
    assert_eq!(
        (pong["id"].as_u64(), pong["server_us"].as_i64()),
        (Some(4), Some(7_000_000))
    );
    host.view.show_tools(ToolFrame::default());
    loop {
        if let Message::Binary(bytes) = next(&mut page).await {
            assert_eq!(bytes[0], 3);
            break;
        }
    }
    host.view.goodbye(PageId(1), "the host ended the session");
    assert_eq!(
        text(&mut page).await["sentence"],
        "the host ended the session"
    );
    assert_eq!(closed(&mut page).await.0, 1001);
}

#[tokio::test]
async fn nonsense_closes_its_page_with_a_sentence_and_no_other() {
    let mut host = Host::start();
    let mut honest = host.join().await;
    let mut motion = vec![16, 1, 0, 0];
    motion.extend(f64::NAN.to_le_bytes());
    motion.extend([0; 32]);
    let after_hello: [(Message, &str); 5] = [
        (Message::text(HELLO), "a second hello"),
        (Message::text("{"), "not in the page's format"),
        (Message::binary(motion), "motion message"),
        (Message::binary(vec![16; 3000]), "more than 2048 bytes"),
        (
            Message::text(
                r#"{"type":"tool","tool":{"kind":"ball","radius_mm":1e9,"length_mm":0,"width_mm":0}}"#,
            ),
            "out of range",
        ),
    ];
    for (message, part) in after_hello {
        let mut page = host.join().await;
        page.send(message).await.unwrap();
        let (code, sentence) = closed(&mut page).await;
        drop(page);
        assert_eq!(code, 1008);
        assert!(sentence.contains(part), "{sentence}");
        let input = host.inputs.recv().await.unwrap();
        assert!(
            matches!(input.event, PageEvent::Closed { violation: Some(_) }),
            "{input:?}"
        );
    }
    honest
        .send(Message::text(r#"{"type":"ping","id":1,"sent_ms":0}"#))
        .await
        .unwrap();
    assert_eq!(text(&mut honest).await["type"], "pong");
}

#[tokio::test]
async fn page_without_a_hello_is_closed() {
    let host = Host::start();
    let mut silent = host.open().await;
    assert_eq!(
        closed(&mut silent).await,
        (1008, "no hello within 5 s".to_owned())
    );
}

#[tokio::test]
async fn flood_and_huge_message_end_their_page_only() {
    let mut host = Host::start();
    let mut honest = host.join().await;
    let mut flood = host.join().await;
    let mut huge = host.join().await;
    for _ in 0..10_000 {
        let ping = Message::text(r#"{"type":"ping","id":1,"sent_ms":0}"#);
        if flood.feed(ping).await.is_err() {
            break;
        }
    }
    let _ = flood.flush().await;
    // The connection may break while the message is still being sent.
    let _ = huge.send(Message::text("x".repeat(10 << 20))).await;
    let mut ended = BTreeSet::new();
    while ended.len() < 2 {
        let input = tokio::time::timeout(Duration::from_secs(20), host.inputs.recv()).await;
        let input = input.expect("a page goes on").unwrap();
        if matches!(input.event, PageEvent::Closed { .. }) {
            ended.insert(input.page);
        }
    }
    assert_eq!(ended, BTreeSet::from([PageId(2), PageId(3)]));
    honest
        .send(Message::text(r#"{"type":"ping","id":9,"sent_ms":0}"#))
        .await
        .unwrap();
    assert_eq!(text(&mut honest).await["id"], 9);
}

#[tokio::test]
async fn page_that_reads_nothing_delays_no_other() {
    let mut host = Host::start();
    let _slow = host.join().await;
    let mut quick = host.join().await;
    let sentence = "x".repeat(60_000);
    for _ in 0..100 {
        host.view.notice(None, &sentence);
        loop {
            if text(&mut quick).await["type"] == "notice" {
                break;
            }
        }
    }
}
