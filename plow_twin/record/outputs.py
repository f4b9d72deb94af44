"""Create the messages of a publication from the table of topics, in a live run and in a replay."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.record.messages import JointState, Message, Odometry
from plow_twin.record.template import Template
from plow_twin.stream.outputs import Published
from plow_twin.stream.topics import JOINT_STATE, Cadence, Topic, names_of, topics_of

Array = NDArray[np.float64]

#: Topics whose messages a replay can compute from the journal.
REPLAYED: Final = topics_of(Cadence.EACH, Cadence.FOLLOWED, Cadence.SLOW)
#: Topics on which only a marked publication has a message.
MARKED: Final = topics_of(Cadence.MARKED)
PUBLICATION_TOPICS: Final = tuple(topic.name for topic in REPLAYED)
#: Topics on which only a twin with `follow: full` publishes.
FOLLOWED_TOPICS: Final = names_of(Cadence.FOLLOWED)


def publication_messages(
    published: Published, frame_id: str, child_frame_id: str, topics: tuple[Topic, ...] = REPLAYED
) -> dict[str, Message]:
    """Return the messages of a publication by base name of the topic.

    Slow topics have a message only if the publication has a slow part, and the topics `MARKED` only if it is marked.
    """
    messages: dict[str, Message] = {}
    for topic in topics:
        records = topic.record_of(published)
        if len(records) and (topic.cadence is not Cadence.FOLLOWED or published.with_intervals):
            numbers = np.concatenate(topic.numbers(records), axis=1)[0]
            messages[topic.name] = message(topic, int(records["stamp_ns"][0]), numbers, frame_id, child_frame_id)
    return messages


def message(topic: Topic, stamp_ns: int, numbers: Array, frame_id: str, child_frame_id: str) -> Message:
    """Return the message of a topic. `numbers` has the order of the columns of the topic."""
    ends = np.cumsum([sum(count for _, count in parts) for parts in topic.columns.values()])
    fields = dict(zip(topic.columns, np.split(numbers, ends[:-1]), strict=True))
    if topic.type == JOINT_STATE:
        return JointState(stamp_ns, frame_id, topic.names, **fields)
    x, y, z, w, vx, vy, omega = numbers.tolist()
    return Odometry(stamp_ns, frame_id, child_frame_id, (x, y, 0.0), (0.0, 0.0, z, w), (vx, vy, 0.0), (0.0, 0.0, omega))


def template(topic: Topic, frame_id: str, child_frame_id: str) -> Template:
    """Return the template of the messages on a topic. To create a message, replace its stamp and its numbers."""
    return Template.of(lambda numbers: message(topic, 0, numbers, frame_id, child_frame_id), topic.count)


def publication_templates(frame_id: str, child_frame_id: str) -> dict[str, Template]:
    """Return the templates of the messages on the topics in `REPLAYED`, by base name of the topic."""
    return {topic.name: template(topic, frame_id, child_frame_id) for topic in REPLAYED}
