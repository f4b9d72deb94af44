"""Connection to an OPC UA server, with a subscription and access to the history."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from asyncua import ua
from asyncua.client.client import Client
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.status_codes import StatusCodes
from asyncua.ua.uaerrors import UaError

from plow_twin.live.bridge.access import Access
from plow_twin.live.bridge.opcua.readings import Counts, date_of
from plow_twin.live.bridge.opcua.security import identify, secure
from plow_twin.live.bridge.source import BridgeError

#: Publishing interval that is requested from the server [ms]. It is two thirds of the largest allowed age of a sample.
PUBLISHING_MS: Final = 10.0
#: Length of the queue that is requested for each node [values]. At 10 kHz, the queue covers 1 s.
_QUEUE: Final = 10_000
#: Interval at which a server without new values sends a message [s]. After three intervals without a message, the
#: connection is broken.
_KEEPALIVE_S: Final = 2.0
#: Time after which the server deletes the subscription of a client that has disappeared [s].
_LIFETIME_S: Final = 60.0
_MOST_REPEATED: Final = 100
_ANSWER_S: Final = 10.0
_CLOSE_S: Final = 2.0
_LARGEST_MESSAGE: Final = 64 << 20
#: Largest size of a chunk of a message [B]. By the OPC UA standard, a client must accept chunks of 8 KiB.
_LARGEST_PART: Final = 1 << 20
#: Largest number of values that are read from the history at a time. Ten nodes at 10 kHz fill it in 10 s.
_MOST_HISTORY: Final = 1_000_000
#: Largest sequence number of a message. The next number is 1.
_LAST_NUMBER: Final = 2**32 - 1

#: Function that receives pairs of node number and value. The second argument is True if values before the pairs were
#: lost.
Take = Callable[[list[tuple[int, Any]], bool], Awaitable[None]]


@dataclass(frozen=True)
class Revised:
    """Intervals [ms] and queue length [values] that the server grants."""

    publishing_ms: float
    sampling_ms: float
    queue: int

    def complaint(self, sampling_ms: float) -> str:
        """Return a text about requests that the server does not grant, or an empty string if it grants all requests."""
        slow = self.sampling_ms > max(1.01 * sampling_ms, self.publishing_ms if sampling_ms == 0.0 else 0.0)
        revised = [f"samples every {self.sampling_ms:g} ms, requested every {sampling_ms:g} ms"] * slow
        needed = self.publishing_ms / sampling_ms if sampling_ms else 1.0
        revised += [f"queues {self.queue} values, but {needed:.0f} arrive between two messages"] * (self.queue < needed)
        return f"the server {'; '.join(revised)}" if revised else ""


class Link:
    """Connection to a server with a subscription to nodes.

    The namespace number in the identifier of a node is an index of `uris`, the namespaces at the first connection. If
    `uris` is empty, the current namespaces of the server are used. `sampling_ms` is the requested sampling interval
    [ms]; 0 requests the fastest. The function `take` receives the values.
    """

    def __init__(
        self,
        access: Access,
        host: str,
        nodes: Sequence[ua.NodeId],
        uris: Sequence[str],
        sampling_ms: float,
        take: Take,
        counts: Counts,
    ) -> None:
        self._access, self._host, self._nodes = access, host, list(nodes)
        #: namespaces of the server, by number
        self.uris = list(uris)
        self._sampling_ms, self._take, self._counts = sampling_ms, take, counts
        # the watchdog waits for three intervals, because a single late answer does not mean a broken connection
        self._client = Client(access.url, timeout=_ANSWER_S, watchdog_intervall=3.0 * _KEEPALIVE_S)
        _bound(self._client)
        if access.user:
            self._client.set_user(access.user)
            self._client.set_password(access.password)
        self._subscription = 0
        self._next_number: int | None = None
        self._keepalive_s = _KEEPALIVE_S
        self._heard_s = 0.0
        self._ended = ""

    async def open(self) -> Revised:
        """Connect to the server, subscribe to the nodes, and return the granted intervals.

        Raise `BridgeError` if the certificate is not trusted or a node cannot be subscribed to, and `OSError`,
        `UaError` or `TimeoutError` if the server does not answer or refuses the connection.
        """
        if self._access.certificate is not None:
            await secure(self._client, self._access, self._host)
        if self._access.user_certificate is not None:
            await identify(self._client, self._access)
        await self._client.connect()
        before, self.uris = self.uris, await self._client.get_namespace_array()
        self._nodes = [self._placed(node, before or self.uris) for node in self._nodes]
        return await self._subscribe()

    async def close(self) -> None:
        """Disconnect."""
        try:
            await asyncio.wait_for(self._client.disconnect(), _CLOSE_S)
        except Exception:  # the type of the error depends on the state of the connection
            self._client.disconnect_socket()

    def _placed(self, node: ua.NodeId, uris: Sequence[str]) -> ua.NodeId:
        """Return a node with the current number of its namespace, which may have changed when the server restarted."""
        uri = getattr(node, "NamespaceUri", None)
        if uri is None:
            uri = uris[node.NamespaceIndex] if node.NamespaceIndex < len(uris) else None
        if uri is None:
            return node  # the server will report an unknown node
        if uri not in self.uris:
            raise BridgeError(f"node: got namespace {uri}, expected one of the server: {', '.join(self.uris)}")
        return ua.NodeId(node.Identifier, ua.Int16(self.uris.index(uri)), node.NodeIdType)

    @property
    def trouble(self) -> str:
        """Reason why no value can arrive. The text is empty while the server answers."""
        if self._ended:
            return self._ended
        if not self._client.uaclient.has_transport:
            return "the server has closed it"
        silent_s = time.monotonic() - self._heard_s
        return f"no sign of life for {silent_s:.0f} s" if silent_s > 3.0 * self._keepalive_s else ""

    async def history(self, begin_ns: int, end_ns: int) -> list[tuple[int, Any]]:
        """Return pairs of node number and value for all stamps from `begin_ns` to `end_ns`, inclusive [ns].

        Raise `UaError` if the server has no history of a node, or if the answers do not end.
        """
        details = ua.ReadRawModifiedDetails(
            IsReadModified=False,
            StartTime=date_of(begin_ns),
            EndTime=date_of(end_ns + 1000),
            NumValuesPerNode=0,
            ReturnBounds=False,
        )
        values_read: list[tuple[int, Any]] = []
        reached = [details.StartTime] * len(self._nodes)
        requested = [(number, ua.HistoryReadValueId(NodeId=node)) for number, node in enumerate(self._nodes)]
        while requested:
            request = ua.HistoryReadParameters(
                details, ua.TimestampsToReturn.Both, False, [read for _, read in requested]
            )
            results = await self._client.uaclient.history_read(request)
            more = []
            for (number, read), result in zip(requested, results, strict=True):
                result.StatusCode.check()
                values = getattr(result.HistoryData, "DataValues", None) or []
                values_read += [(number, value) for value in values]
                if result.ContinuationPoint:
                    newest = values[-1].SourceTimestamp or values[-1].ServerTimestamp if values else None
                    if newest is None or newest <= reached[number] or len(values_read) > _MOST_HISTORY:
                        raise UaError("history: got an endless answer")
                    reached[number] = newest
                    more.append(
                        (number, ua.HistoryReadValueId(read.NodeId, ContinuationPoint=result.ContinuationPoint))
                    )
            requested = more
        return values_read

    async def _subscribe(self) -> Revised:
        request = ua.CreateSubscriptionParameters(
            RequestedPublishingInterval=PUBLISHING_MS,
            RequestedLifetimeCount=round(_LIFETIME_S * 1e3 / PUBLISHING_MS),
            RequestedMaxKeepAliveCount=round(_KEEPALIVE_S * 1e3 / PUBLISHING_MS),
            MaxNotificationsPerPublish=0,
            PublishingEnabled=True,
            Priority=0,
        )
        self._heard_s = time.monotonic()
        granted = await self._client.uaclient.create_subscription(request, self._on_publish)
        self._subscription = granted.SubscriptionId
        self._keepalive_s = granted.RevisedPublishingInterval * granted.RevisedMaxKeepAliveCount * 1e-3
        # each stamp is a sample, so a node with a new stamp must be sent even if its value has not changed
        by_stamp = ua.DataChangeFilter(Trigger=ua.DataChangeTrigger.StatusValueTimestamp)
        results = await self._monitor(range(len(self._nodes)), by_stamp)
        refused = [
            number
            for number, result in results.items()
            if result.StatusCode.value
            in (StatusCodes.BadMonitoredItemFilterUnsupported, StatusCodes.BadFilterNotAllowed)
        ]
        if refused:
            results |= await self._monitor(refused, None)
        for number, result in results.items():
            if not result.StatusCode.is_good():
                node = self._nodes[number].to_string()
                raise BridgeError(f"node: got {node}, expected a node of the server: {result.StatusCode.name}")
        return Revised(
            granted.RevisedPublishingInterval,
            max(result.RevisedSamplingInterval for result in results.values()),
            min(result.RevisedQueueSize for result in results.values()),
        )

    async def _monitor(self, numbers: Sequence[int], trigger: Any) -> dict[int, ua.MonitoredItemCreateResult]:
        items = [
            ua.MonitoredItemCreateRequest(
                ua.ReadValueId(self._nodes[number], AttributeIds.Value),
                ua.MonitoringMode.Reporting,
                ua.MonitoringParameters(
                    ClientHandle=number,
                    SamplingInterval=self._sampling_ms,
                    Filter=trigger,
                    QueueSize=_QUEUE,
                    DiscardOldest=True,
                ),
            )
            for number in numbers
        ]
        request = ua.CreateMonitoredItemsParameters(self._subscription, ua.TimestampsToReturn.Both, items)
        return dict(zip(numbers, await self._client.uaclient.create_monitored_items(request), strict=True))

    async def _on_publish(self, result: ua.PublishResult) -> None:
        self._heard_s = time.monotonic()
        message = result.NotificationMessage
        if not message.NotificationData:
            return
        missing = self._missing(message.SequenceNumber)
        lost = 0
        for number in missing[:_MOST_REPEATED]:
            again = await self._again(number)
            lost += again is None
            if again is not None:
                await self._take_message(again, lost=False)
        lost += len(missing[_MOST_REPEATED:])
        self._counts.notifications_lost += lost
        await self._take_message(message, lost=lost > 0)

    def _missing(self, number: int) -> range:
        expected = self._next_number
        if expected is not None and number == expected - 1:  # the server has repeated the last message
            return range(0)
        self._next_number = number % _LAST_NUMBER + 1
        return range(0) if expected is None or number < expected else range(expected, number)

    async def _again(self, number: int) -> ua.NotificationMessage | None:
        try:
            message = await self._client.uaclient.session.republish(self._subscription, number)
        except UaError:
            return None
        return message if message.NotificationData else None

    async def _take_message(self, message: ua.NotificationMessage, *, lost: bool) -> None:
        values: list[tuple[int, Any]] = []
        for part in message.NotificationData:
            if isinstance(part, ua.DataChangeNotification):
                values += [(item.ClientHandle, item.Value) for item in part.MonitoredItems]
            elif isinstance(part, ua.StatusChangeNotification):
                self._ended = f"the subscription has ended: {part.Status.name}"
        await self._take(values, lost)


def _bound(client: Client) -> None:
    """Limit the size of the messages that a client accepts, because asyncua has no limit."""
    connection = client.uaclient
    make = connection._make_protocol

    def bounded() -> Any:
        protocol = make()
        receive = protocol.data_received

        def data_received(data: bytes) -> None:
            begun = len(protocol.receive_buffer or b"")
            if begun > _LARGEST_PART or protocol._connection._incoming_size > _LARGEST_MESSAGE:
                protocol.disconnect_socket()
            else:
                receive(data)

        setattr(protocol, "data_received", data_received)  # noqa: B010
        return protocol

    setattr(connection, "_make_protocol", bounded)  # noqa: B010
