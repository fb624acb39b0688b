//! The HTTP server of the page, and the session's end of it.

use std::future::ready;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use axum::Router;
use axum::extract::State as Extracted;
use axum::extract::ws::WebSocketUpgrade;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use axum::serve::Listener;
use palpate_protocol::ServerTime;
use palpate_transport::{PageAttempt, PageDoor, PageEndpoint, PageTls};
use tokio::net::TcpListener;
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};

use crate::connection::{self, Halves, TEXT_BYTES_MAX};
use crate::feed::{Feed, FeedState};
use crate::https::HttpsListener;
use crate::hub::{Hub, HubEvent};
use crate::message::{FromHost, InvitationMessage, State, Welcome};
use crate::page::{Clock, FRAMES_MAX, Page, PageId, PageInput, TEXTS_MAX};
use crate::step_limit::ToolLimits;
use crate::tool_code::ToolFrame;
use crate::{asset, origin};

/// Name of the format, as a WebSocket subprotocol.
const SUBPROTOCOL: &str = "palpate-view.1";

/// Pages at once; further ones are refused with 503.
const PAGES_MAX: usize = 128;

/// Events that may wait for the hub, and inputs for the session.
const EVENTS_MAX: usize = 1024;

/// States and tools that may wait for the hub.
const PICTURES_MAX: usize = 8;

/// A bound address of a page.
pub struct ViewListener {
    listener: std::net::TcpListener,
    address: SocketAddr,
}

impl ViewListener {
    /// Binds an address and TCP port; port 0 takes any free one.
    pub fn bind(address: SocketAddr) -> Result<Self, ViewError> {
        let at_address = |source| ViewError { address, source };
        let listener = std::net::TcpListener::bind(address).map_err(at_address)?;
        listener.set_nonblocking(true).map_err(at_address)?;
        let address = listener.local_addr().map_err(at_address)?;
        Ok(Self { listener, address })
    }
}

/// Where and with which clock to serve.
pub struct ViewConfig {
    /// The bound address.
    pub listener: ViewListener,
    /// Public name of the host, which browsers may use beside addresses and `localhost`.
    pub host: Option<String>,
    /// TLS of the page; `None` serves plain HTTP.
    pub tls: Option<PageTls>,
    /// The place where browsers arrive by WebTransport; `None` leaves WebSockets alone.
    pub web_transport: Option<PageDoor>,
    /// The clock of the session.
    pub clock: Box<dyn Fn() -> ServerTime + Send + Sync>,
}

impl ViewConfig {
    /// Plain HTTP and WebSockets at a bound address, for this machine.
    pub fn local(
        listener: ViewListener,
        clock: impl Fn() -> ServerTime + Send + Sync + 'static,
    ) -> Self {
        Self {
            listener,
            host: None,
            tls: None,
            web_transport: None,
            clock: Box::new(clock),
        }
    }
}

/// The page can not be served.
#[derive(Debug, thiserror::Error)]
#[error("the page can not be served at {address}: {source}; name another address with --view")]
pub struct ViewError {
    /// The address.
    address: SocketAddr,
    /// The cause.
    source: std::io::Error,
}

/// Where a page is served.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PageAddress {
    /// Address and TCP port.
    pub socket: SocketAddr,
    /// Whether by HTTPS.
    pub is_https: bool,
}

impl PageAddress {
    /// The URL for a browser. `host` replaces an address of all interfaces.
    pub fn url(&self, host: &str, fragment: &str) -> String {
        let ip = self.socket.ip();
        let host = if ip.is_unspecified() {
            host.to_owned()
        } else {
            ip.to_string()
        };
        self.url_of(&host, fragment)
    }

    /// The URL with a host name or address that leads to this machine.
    pub fn url_of(&self, host: &str, fragment: &str) -> String {
        let scheme = if self.is_https { "https" } else { "http" };
        let (open, close) = if host.contains(':') {
            ("[", "]")
        } else {
            ("", "")
        };
        let port = self.socket.port();
        format!("{scheme}://{open}{host}{close}:{port}/#{fragment}")
    }
}

/// The session's end of all pages. Nothing in it blocks.
#[derive(Clone)]
pub struct ViewServer {
    address: PageAddress,
    hub: mpsc::Sender<HubEvent>,
    /// States and tools; the next one replaces one that finds no room.
    news: mpsc::Sender<HubEvent>,
    feed: Arc<FeedState>,
    tool_limits: Arc<Mutex<ToolLimits>>,
}

/// Data that the HTTP handlers share.
struct Shared {
    hub: mpsc::Sender<HubEvent>,
    inputs: mpsc::Sender<PageInput>,
    clock: Clock,
    next: AtomicU64,
    places: Arc<Semaphore>,
    host: Option<String>,
}

impl ViewServer {
    /// Serves the page from tasks of this runtime. Returns the solver's end and the events of all pages as well.
    pub fn start(
        config: ViewConfig,
        runtime: &Handle,
    ) -> Result<(Self, Feed, mpsc::Receiver<PageInput>), ViewError> {
        let ViewListener { listener, address } = config.listener;
        let at_address = |source| ViewError { address, source };
        let _inside = runtime.enter();
        let listener = TcpListener::from_std(listener).map_err(at_address)?;
        let (hub, events) = mpsc::channel(EVENTS_MAX);
        let (news, pictures) = mpsc::channel(PICTURES_MAX);
        let (inputs, received) = mpsc::channel(EVENTS_MAX);
        let (feed, feed_state, tissue) = Feed::new();
        let shared = Shared {
            hub: hub.clone(),
            inputs,
            clock: Arc::from(config.clock),
            next: AtomicU64::new(1),
            places: Arc::new(Semaphore::new(PAGES_MAX)),
            host: config.host,
        };
        let shared = Arc::new(shared);
        let endpoint = config.web_transport.as_ref().map(PageDoor::endpoint);
        let port = endpoint.as_ref().map(PageEndpoint::port);
        let router = Router::new()
            .route("/session", get(open))
            .route(
                "/transport",
                get(move || ready(describe(endpoint.as_ref()))),
            )
            .fallback(async move |uri: Uri, headers: HeaderMap| asset::serve(&uri, &headers, port))
            .with_state(Arc::clone(&shared));
        if let Some(door) = config.web_transport {
            runtime.spawn(accept(door, address.port(), shared));
        }
        let hub_task = Hub::new(Arc::clone(&feed_state));
        runtime.spawn(hub_task.run(events, pictures, tissue));
        let is_https = config.tls.is_some();
        match config.tls {
            Some(tls) => {
                let listener = HttpsListener::new(listener, tls).map_err(at_address)?;
                runtime.spawn(serve_http(listener, router));
            }
            None => {
                runtime.spawn(serve_http(listener, router));
            }
        }
        let address = PageAddress {
            socket: address,
            is_https,
        };
        let server = Self {
            address,
            hub,
            news,
            feed: feed_state,
            tool_limits: Arc::default(),
        };
        Ok((server, feed, received))
    }

    /// Where the page is served.
    pub fn address(&self) -> PageAddress {
        self.address
    }

    /// Whether a page takes part; otherwise states and tools are not needed.
    pub fn is_watched(&self) -> bool {
        self.feed.is_watched()
    }

    /// Lets a page take part.
    pub fn welcome(&self, page: PageId, welcome: &Welcome) {
        self.tell(HubEvent::Admitted(
            page,
            FromHost::Welcome(welcome).to_text(),
        ));
    }

    /// Refuses a page, with a sentence.
    pub fn refuse(&self, page: PageId, sentence: &str, is_temporary: bool) {
        let text = FromHost::Refused {
            sentence,
            is_temporary,
        };
        self.tell(HubEvent::End(page, text.to_text(), sentence.to_owned()));
    }

    /// Ends a page's session, with a sentence.
    pub fn goodbye(&self, page: PageId, sentence: &str) {
        let text = FromHost::Goodbye { sentence }.to_text();
        self.tell(HubEvent::End(page, text, sentence.to_owned()));
    }

    /// Ends all pages, with a sentence.
    pub fn close(&self, sentence: &str) {
        let text = FromHost::Goodbye { sentence }.to_text();
        self.tell(HubEvent::Close(text, sentence.to_owned()));
    }

    /// Shows a sentence on one page, or on all.
    pub fn notice(&self, page: Option<PageId>, sentence: &str) {
        let text = FromHost::Notice { sentence }.to_text();
        self.tell(match page {
            Some(page) => HubEvent::Text(page, text),
            None => HubEvent::Everyone(text),
        });
    }

    /// Shows the addresses of an invitation on one page, or on all.
    pub fn show_invitation(&self, page: Option<PageId>, invitation: &InvitationMessage) {
        let text = FromHost::Invitation(invitation).to_text();
        self.tell(match page {
            Some(page) => HubEvent::Text(page, text),
            None => HubEvent::Everyone(text),
        });
    }

    /// Shows the state of the session on all pages.
    pub fn show_state(&self, state: &State) {
        let _ = self
            .news
            .try_send(HubEvent::State(FromHost::State(state).to_text()));
    }

    /// Shows the tools on all pages.
    pub fn show_tools(&self, mut tools: ToolFrame) {
        let limits = self.tool_limits.lock();
        limits
            .unwrap_or_else(PoisonError::into_inner)
            .limit(&mut tools.tools);
        let _ = self.news.try_send(HubEvent::Tools(tools.encode()));
    }

    /// Pages cause a few of these events each; the hub is far behind if they find no room.
    fn tell(&self, event: HubEvent) {
        if self.hub.try_send(event).is_err() {
            tracing::warn!("a message to a page was dropped, because this machine is too busy");
        }
    }
}

async fn serve_http<L>(listener: L, router: Router)
where
    L: Listener<Addr = SocketAddr>,
{
    if let Err(error) = axum::serve(listener, router).await {
        tracing::warn!(%error, "the page is no longer served");
    }
}

async fn open(
    upgrade: WebSocketUpgrade,
    headers: HeaderMap,
    Extracted(shared): Extracted<Arc<Shared>>,
) -> Response {
    if !origin::is_own(&headers, shared.host.as_deref()) {
        return (
            StatusCode::FORBIDDEN,
            "the page comes from another origin\n",
        )
            .into_response();
    }
    let Ok(place) = Arc::clone(&shared.places).try_acquire_owned() else {
        return (StatusCode::SERVICE_UNAVAILABLE, "too many pages are open\n").into_response();
    };
    upgrade
        .protocols([SUBPROTOCOL])
        .max_message_size(TEXT_BYTES_MAX)
        .max_frame_size(TEXT_BYTES_MAX)
        .on_upgrade(move |socket| serve(connection::web_socket(socket), shared, place))
}

/// Describes the endpoint for WebTransport as JSON.
fn describe(endpoint: Option<&PageEndpoint>) -> Response {
    let Some(endpoint) = endpoint else {
        return (StatusCode::NOT_FOUND, "no WebTransport here\n").into_response();
    };
    let hash = data_encoding::HEXLOWER.encode(&endpoint.certificate_hash().0);
    let description = serde_json::json!({
        "port": endpoint.port(),
        "certificate_hashes": [hash],
    });
    let headers = [
        (CONTENT_TYPE, "application/json"),
        // The certificate changes.
        (CACHE_CONTROL, "no-store"),
    ];
    (headers, description.to_string()).into_response()
}

/// Accepts browsers by WebTransport until the server is gone. `page_port` is the port of the page.
async fn accept(mut door: PageDoor, page_port: u16, shared: Arc<Shared>) {
    while let Some(attempt) = door.accept().await {
        tokio::spawn(greet(attempt, page_port, Arc::clone(&shared)));
    }
}

async fn greet(attempt: PageAttempt, page_port: u16, shared: Arc<Shared>) {
    if attempt.path() != "/session" {
        return attempt.refuse(StatusCode::NOT_FOUND.as_u16()).await;
    }
    let (origin, name) = (attempt.origin(), shared.host.as_deref());
    if !origin::is_own_page(origin.as_deref(), attempt.host(), page_port, name) {
        return attempt.refuse(StatusCode::FORBIDDEN.as_u16()).await;
    }
    let Ok(place) = Arc::clone(&shared.places).try_acquire_owned() else {
        return attempt
            .refuse(StatusCode::SERVICE_UNAVAILABLE.as_u16())
            .await;
    };
    if let Some(session) = attempt.accept().await {
        serve(connection::web_transport(session), shared, place).await;
    }
}

async fn serve(halves: Halves, shared: Arc<Shared>, _place: OwnedSemaphorePermit) {
    let (reliable, reliable_receiver) = mpsc::channel(TEXTS_MAX);
    let (frames, frame_receiver) = mpsc::channel(FRAMES_MAX);
    let id = PageId(shared.next.fetch_add(1, Ordering::Relaxed));
    if shared
        .hub
        .send(HubEvent::Opened(id, reliable, frames))
        .await
        .is_err()
    {
        return;
    }
    let page = Page {
        id,
        reliable: reliable_receiver,
        frames: frame_receiver,
        hub: shared.hub.clone(),
        inputs: shared.inputs.clone(),
        clock: Arc::clone(&shared.clock),
    };
    page.serve(halves).await;
}
