from .session import PeopleSession as PeopleSession
from .session import track as track
from .state import PeopleConfig as PeopleConfig
from .tracker import people_scene as people_scene
